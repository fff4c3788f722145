"""Jaw design by gradients of the engine. Nothing is here before it works."""
