"""The language of extra physical terms: safe arithmetic expressions, evaluated by numpy or turned into a graph.

An expression such as ``"-0.5 * width * approach1"`` is parsed by Python's parser, but only the nodes listed here are
accepted: numbers, names, ``+ - * / **`` (exponent a plain number up to 16), comparisons, and calls of

    sin cos tan asin acos atan atan2 sinh cosh tanh exp log sqrt abs sign minimum maximum where step

``where(condition, a, b)`` takes a where the condition holds, ``step(x)`` is 1 for x >= 0. In a graph both branches of
``where`` are computed, so neither may be infinite where the other is chosen.

Names are the term's own parameters (short names) or variables:

- ``q1..qN`` (sense of q, rad or m), ``approach1..N`` (-1, 0, +1; 0 where not recorded), ``move1..N`` (last move of the
  joint, rad or m; 0 where not recorded),
- ``torque1..N``: static moment of the weights about the joint's own line in the sense of q (N m; N if sliding),
- ``<frame>_mroll``, ``_mpitch``, ``_myaw``: moment about the line about which that angle turns (N m),
- ``base_mx``, ``base_my``, ``base_mz``: moment about the base origin in base coordinates (N m),
- ``payload_mass`` (kg), ``index`` (row number), and any numeric covariate column by its name.
"""

import ast
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from types import CodeType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robcal.errors import InvalidInput

Array = NDArray[np.float64]

MAX_LENGTH = 4000
MAX_NODES = 1000
MAX_EXPONENT = 16.0

_UNARY = "sin cos tan asin acos atan sinh cosh tanh exp log sqrt abs sign step"
_ARGUMENTS = dict.fromkeys(_UNARY.split(), 1) | {"atan2": 2, "minimum": 2, "maximum": 2, "where": 3}

# Numbers become numpy's or CasADi's at once: Python's own would turn (-8) ** 0.5 complex and raise on 1 / 0.
_NUMPY: dict[str, Callable[..., Any]] = {
    "number": np.float64,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sign": np.sign,
    "step": lambda x: np.where(np.asarray(x) >= 0, 1.0, 0.0),
    "atan2": np.arctan2,
    "minimum": np.minimum,
    "maximum": np.maximum,
    "where": lambda c, a, b: np.where(np.asarray(c) != 0, a, b),
}
_NAMESPACE: dict[str, Any] = {"__builtins__": {}, **_NUMPY}
_GRAPH: dict[str, Callable[..., Any]] = {
    "number": ca.SX,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "exp": ca.exp,
    "log": ca.log,
    "sqrt": ca.sqrt,
    "abs": ca.fabs,
    "sign": ca.sign,
    "step": lambda x: x >= 0,
    "atan2": ca.atan2,
    "minimum": ca.fmin,
    "maximum": ca.fmax,
    "where": lambda c, a, b: ca.if_else(c, a, b),
}
_BINARY: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
    ast.Pow: lambda a, b: a**b,
}
_COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}


@lru_cache(maxsize=32768)
def parse(expression: str) -> ast.expr:
    """Checked syntax tree of an expression.

    Raises
    ------
    InvalidInput : not an expression of the language; the message names the offending part.
    """
    if not isinstance(expression, str) or not expression.strip():
        raise InvalidInput("a term needs an expression: an arithmetic formula of its parameters and variables")
    if len(expression) > MAX_LENGTH:
        raise InvalidInput(f"the expression of a term is longer than {MAX_LENGTH} characters")
    try:
        tree = ast.parse(expression.strip(), mode="eval").body
        nodes = sum(1 for _ in ast.walk(tree))
        if nodes > MAX_NODES:
            raise InvalidInput(f"the expression '{expression[:60]}...' has more than {MAX_NODES} elements")
        _check(tree, expression)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InvalidInput(f"'{expression[:120]}' is not an arithmetic expression: {error}") from error
    return tree


@lru_cache(maxsize=32768)
def names_in(expression: str) -> frozenset[str]:
    """Names of variables and parameters that occur in an expression (functions excluded)."""
    tree = parse(expression)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return frozenset(n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and id(n) not in called)


def evaluate(expression: str, variables: Mapping[str, ArrayLike]) -> Array:
    """Value of an expression for arrays of variables (and parameters), broadcast against each other.

    Raises
    ------
    InvalidInput : a name without value, or an expression outside the language.
    """
    values = {}
    for name in names_in(expression):
        if name not in variables:
            raise InvalidInput(
                f"'{expression[:120]}': '{name}' is neither a parameter of the term nor a known variable"
            )
        values[name] = np.asarray(variables[name], dtype=float)
    with np.errstate(all="ignore"):
        return np.asarray(eval(_code(expression), _NAMESPACE, values), dtype=float)


@lru_cache(maxsize=32768)
def _code(expression: str) -> CodeType:
    """Byte code of a checked tree: only whitelisted nodes and functions, so evaluating it is as safe as walking it."""
    tree = ast.Expression(parse(expression))
    return compile(ast.fix_missing_locations(tree), "<term>", "eval")


def graph(expression: str, symbols: Mapping[str, ca.SX]) -> ca.SX:
    """The expression as a CasADi graph of the given symbols.

    Raises
    ------
    InvalidInput : a name without symbol, or an expression outside the language.
    """
    return ca.SX(_walk(parse(expression), symbols, _GRAPH, expression))


def gradient(expression: str, variables: Mapping[str, ArrayLike], wanted: Sequence[str]) -> Array:
    """Exact derivatives (n, k) of an expression by the k wanted names, at n values of the variables."""
    used = sorted(names_in(expression))
    missing = [name for name in used if name not in variables]
    if missing:
        raise InvalidInput(f"'{expression}' needs a value for {', '.join(missing)}")
    symbols = {name: ca.SX.sym(name) for name in used}
    value = graph(expression, symbols)
    columns = [ca.jacobian(value, symbols[name]) if name in symbols else ca.SX(0) for name in wanted]
    function = ca.Function("gradient", [ca.vertcat(*symbols.values())], [ca.densify(ca.vertcat(*columns))])
    table = np.broadcast_arrays(*(np.atleast_1d(np.asarray(variables[name], dtype=float)) for name in used))
    n = len(table[0]) if used else 1
    points = np.stack(table) if used else np.zeros((0, 1))
    return np.asarray(function.map(n)(points).full().T, dtype=float).reshape(n, len(wanted))


@lru_cache(maxsize=4096)
def identifier(name: str) -> str:
    """A frame's or column's name as it is written in expressions: other characters become underscores."""
    word = re.sub(r"\W", "_", name)
    return f"_{word}" if word[:1].isdigit() else word


def _check(node: ast.AST, expression: str) -> None:
    """Depth-first whitelist; whatever is not listed is refused."""
    if isinstance(node, ast.Constant):
        return _check_number(node, expression)
    if isinstance(node, ast.Name):
        if node.id.startswith("__"):
            raise InvalidInput(f"'{expression[:120]}': the name '{node.id}' is not allowed")
        return None
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
        return _check(node.operand, expression)
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        if isinstance(node.op, ast.Pow):
            exponent = _literal(node.right)
            if exponent is None or abs(exponent) > MAX_EXPONENT:
                raise InvalidInput(f"'{expression[:120]}': an exponent must be a number of at most {MAX_EXPONENT:g}")
        _check(node.left, expression)
        return _check(node.right, expression)
    if isinstance(node, ast.Compare):
        if len(node.ops) != 1 or type(node.ops[0]) not in _COMPARE:
            raise InvalidInput(f"'{expression[:120]}': only one of < <= > >= at a time")
        _check(node.left, expression)
        return _check(node.comparators[0], expression)
    if isinstance(node, ast.Call):
        if not isinstance(node.func, ast.Name) or node.func.id not in _ARGUMENTS or node.keywords:
            raise InvalidInput(f"'{expression[:120]}': only calls of {', '.join(sorted(_ARGUMENTS))} are allowed")
        if len(node.args) != _ARGUMENTS[node.func.id]:
            raise InvalidInput(f"'{expression[:120]}': {node.func.id} takes {_ARGUMENTS[node.func.id]} arguments")
        for argument in node.args:
            _check(argument, expression)
        return None
    raise InvalidInput(f"'{expression[:120]}': {type(node).__name__} is not allowed in a term's expression")


def _check_number(node: ast.Constant, expression: str) -> None:
    if isinstance(node.value, bool) or not isinstance(node.value, int | float):
        raise InvalidInput(f"'{expression[:120]}': {node.value!r} is not a number")
    try:
        finite = math.isfinite(float(node.value))
    except OverflowError:
        finite = False
    if not finite:
        raise InvalidInput(f"'{expression[:120]}': a number is too large")


def _literal(node: ast.AST) -> float | None:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _literal(node.operand)
        return None if value is None else -value
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and abs(node.value) < 1e6:
        return float(node.value)
    return None


def _walk(node: ast.AST, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]], text: str) -> Any:
    if isinstance(node, ast.Constant):
        return functions["number"](float(node.value))  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        if node.id not in values:
            raise InvalidInput(f"'{text[:120]}': '{node.id}' is neither a parameter of the term nor a known variable")
        return values[node.id]
    if isinstance(node, ast.UnaryOp):
        operand = _walk(node.operand, values, functions, text)
        return -operand if isinstance(node.op, ast.USub) else operand
    if isinstance(node, ast.BinOp):
        left, right = (_walk(side, values, functions, text) for side in (node.left, node.right))
        return _BINARY[type(node.op)](left, right)
    if isinstance(node, ast.Compare):
        left, right = (_walk(side, values, functions, text) for side in (node.left, node.comparators[0]))
        return _COMPARE[type(node.ops[0])](left, right)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return functions[node.func.id](*(_walk(a, values, functions, text) for a in node.args))
    raise InvalidInput(f"'{text[:120]}': {type(node).__name__} is not allowed in a term's expression")
