"""CasADi graphs as plain C99: one assignment an operation, no runtime, no allocation, no warnings.

CasADi's own generator brings its calling convention and work arrays along; a controller wants a function of arrays. The
operations are taken from the function's instruction list, so every extra term of a model comes with it.
"""

import math
from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from robcal.errors import InvalidInput

_BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_POW: "pow({0}, {1})",
    ca.OP_CONSTPOW: "pow({0}, {1})",
    ca.OP_FMIN: "fmin({0}, {1})",
    ca.OP_FMAX: "fmax({0}, {1})",
    ca.OP_ATAN2: "atan2({0}, {1})",
    ca.OP_FMOD: "fmod({0}, {1})",
    ca.OP_COPYSIGN: "copysign({0}, {1})",
    ca.OP_HYPOT: "hypot({0}, {1})",
    ca.OP_LT: "({0} < {1}) ? 1.0 : 0.0",
    ca.OP_LE: "({0} <= {1}) ? 1.0 : 0.0",
    ca.OP_EQ: "({0} == {1}) ? 1.0 : 0.0",
    ca.OP_NE: "({0} != {1}) ? 1.0 : 0.0",
    ca.OP_AND: "({0} != 0.0 && {1} != 0.0) ? 1.0 : 0.0",
    ca.OP_OR: "({0} != 0.0 || {1} != 0.0) ? 1.0 : 0.0",
    ca.OP_IF_ELSE_ZERO: "({0} != 0.0) ? {1} : 0.0",
}
_UNARY = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_EXP: "exp({0})",
    ca.OP_LOG: "log({0})",
    ca.OP_SQRT: "sqrt({0})",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_SIN: "sin({0})",
    ca.OP_COS: "cos({0})",
    ca.OP_TAN: "tan({0})",
    ca.OP_ASIN: "asin({0})",
    ca.OP_ACOS: "acos({0})",
    ca.OP_ATAN: "atan({0})",
    ca.OP_SINH: "sinh({0})",
    ca.OP_COSH: "cosh({0})",
    ca.OP_TANH: "tanh({0})",
    ca.OP_FABS: "fabs({0})",
    ca.OP_FLOOR: "floor({0})",
    ca.OP_CEIL: "ceil({0})",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_NOT: "({0} == 0.0) ? 1.0 : 0.0",
    ca.OP_SIGN: "({0} > 0.0) ? 1.0 : (({0} < 0.0) ? -1.0 : 0.0)",
    ca.OP_LOG1P: "log1p({0})",
    ca.OP_EXPM1: "expm1({0})",
    ca.OP_ERF: "erf({0})",
}


def number(value: float) -> str:
    """A finite double as a C literal that reads back to the same bits.

    Raises
    ------
    InvalidInput : not finite; a controller must not get it.
    """
    if not math.isfinite(value):
        raise InvalidInput("the robot's model contains a number that is not finite: it cannot be exported to C")
    text = repr(float(value))
    return text if "." in text or "e" in text else text + ".0"


def array(values: ArrayLike) -> str:
    """A C initialiser of one row of numbers."""
    return "{" + ", ".join(number(float(v)) for v in np.ravel(values)) + "}"


def function_body(function: ca.Function, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    """Statements that read ``inputs[i][k]`` and write ``outputs[i][k]`` (C names of arrays, column-major entries).

    Raises
    ------
    InvalidInput : an operation outside the language of terms.
    """
    lines: list[str] = []
    used: set[int] = set()
    touched: set[int] = set()
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        target, source = function.instruction_output(k), function.instruction_input(k)
        if op == ca.OP_OUTPUT:
            lines.append(f"    {outputs[target[0]]}[{target[1]}] = w{source[0]};")
            continue
        used.add(target[0])
        if op == ca.OP_INPUT:
            touched.add(source[0])
            value = f"{inputs[source[0]]}[{source[1]}]"
        elif op == ca.OP_CONST:
            value = number(function.instruction_constant(k))
        elif op in _BINARY:
            value = _BINARY[op].format(f"w{source[0]}", f"w{source[1]}")
        elif op in _UNARY:
            value = _UNARY[op].format(f"w{source[0]}")
        else:
            raise InvalidInput(f"operation {op} of the robot's graph has no counterpart in C; simplify the term")
        lines.append(f"    w{target[0]} = {value};")
    declared = sorted(used)
    names = [f"w{k}" for k in declared]
    head = [f"    double {', '.join(names[i : i + 12])};" for i in range(0, len(names), 12)]
    head += [f"    (void){inputs[i]};" for i in range(len(inputs)) if i not in touched]
    return "\n".join([*head, *lines])
