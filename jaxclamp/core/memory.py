"""How much memory this process may still take."""

from __future__ import annotations

from pathlib import Path

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
"""where Linux tells"""
ADDRESSES = "ulimit -v"
"""what limits addresses rather than memory: much of them is never used"""


def resident_MB() -> float | None:
    """Memory that this process has now, MB; None where the system does not tell."""
    size = _kB(PROC / "self" / "status", "VmRSS:")
    return None if size is None else size / 1024.0


def limits_MB() -> list[tuple[float, str]]:
    """Memory that this process may still take, MB, and what limits it, the tightest first; [] if not known.

    Of the machine, of `ulimit -v`, and of the group of processes (a container).
    """
    known = (_of_machine(), _of_address_space(), *_of_groups())
    return sorted(limit for limit in known if limit is not None)


def _of_machine() -> tuple[float, str] | None:
    available = _kB(PROC / "meminfo", "MemAvailable:")
    return None if available is None else (available / 1024.0, "the machine")


def _of_address_space() -> tuple[float, str] | None:
    """What `ulimit -v` leaves."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    size = _kB(PROC / "self" / "status", "VmSize:")
    if limit == resource.RLIM_INFINITY or size is None:
        return None
    return limit / 2**20 - size / 1024.0, ADDRESSES


def _of_groups() -> list[tuple[float, str] | None]:
    """What the control group of this process, and each group that it is part of, leaves."""
    try:
        lines = (PROC / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers == "":  # version 2
            root, most, used = CGROUPS, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root, most, used = CGROUPS / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        group = root / name.lstrip("/")
        found += [_of_group(g, most, used) for g in (group, *group.parents) if g.is_relative_to(root)]
    return found


def _of_group(group: Path, most: str, used: str) -> tuple[float, str] | None:
    try:
        limit, taken = (int((group / name).read_text()) for name in (most, used))
        cached = _of_files(group / "memory.stat")
    except (OSError, ValueError):  # no such group here, or "max": no limit
        return None
    return (limit - taken + cached) / 2**20, "the container"


def _of_files(stat: Path) -> int:
    """Bytes of files that are kept in memory and can be dropped."""
    words = stat.read_text().split()
    return next((int(n) for key, n in zip(words[::2], words[1::2], strict=True) if key == "inactive_file"), 0)


def _kB(file: Path, key: str) -> float | None:
    try:
        words = file.read_text().split()
        return float(words[words.index(key) + 1])
    except (OSError, ValueError, IndexError):
        return None
