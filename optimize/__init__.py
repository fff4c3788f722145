"""optimize: the clamp that injures least, by gradients of the engine in `jaxclamp`.

A `DesignProblem` says what may change (any floats of a scene), what is minimised and what must
hold (measures of `jaxclamp`); `minimise` finds the best design with a driver from a well-known library.
"""

from optimize.problem import Constraint, DesignProblem
from optimize.study import Study, minimise
from optimize.variables import Variable

__all__ = ["Constraint", "DesignProblem", "Study", "Variable", "minimise"]
