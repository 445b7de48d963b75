"""Formulas of spectral indices such as (N-R)/(N+R), which are parsed as Python and evaluated without executing code."""

import ast
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from agalign.errors import ConfigurationError
from agalign.values.image import FloatImage

_MAX_LENGTH = 300
"""Characters of a formula: longer ones could exhaust Python's recursion limit."""
_MAX_NUMBER = 1e30
"""Numbers must fit into float32."""
_OPERATORS: Mapping[type, Callable[[Any, Any], Any]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power,
}  # fmt: skip
_SIGNS: Mapping[type, Callable[[Any], Any]] = {ast.UAdd: np.positive, ast.USub: np.negative}
_FUNCTIONS: Mapping[str, Callable[[Any], Any]] = {"sqrt": np.sqrt, "log": np.log, "exp": np.exp, "abs": np.abs}


def symbols_of(formula: str) -> tuple[str, ...]:
    """Return the different names in a formula, in the order of their first use.

    Allowed are names, numbers, + - * / ** (or ^), parentheses, and sqrt, log, exp and abs. Raises ConfigurationError
    for anything else.
    """
    return tuple(dict.fromkeys(_names(_parsed(formula), formula)))


def evaluate(formula: str, values: Mapping[str, FloatImage]) -> FloatImage:
    """Return the value of a formula, float32, given an array for each name; not finite where it is undefined."""
    with np.errstate(all="ignore"):
        return np.asarray(_value(_parsed(formula), values), np.float32)


@lru_cache(maxsize=64)
def _parsed(formula: str) -> ast.expr:
    if len(formula) > _MAX_LENGTH:
        raise ConfigurationError(f"the formula has {len(formula)} characters; at most {_MAX_LENGTH} are allowed")
    try:
        return ast.parse(formula.strip().replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ConfigurationError(f"'{formula}' is not a formula; write one like (N-R)/(N+R)") from None


def _names(node: ast.expr, formula: str) -> Iterator[str]:
    match node:
        case ast.Name(id=name):
            yield name
        case ast.Constant(value=int() | float() as value) if abs(value) < _MAX_NUMBER:
            pass
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            yield from _names(left, formula)
            yield from _names(right, formula)
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _SIGNS:
            yield from _names(operand, formula)
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            yield from _names(argument, formula)
        case _:
            part = ast.unparse(node)
            raise ConfigurationError(
                f"'{part}' is not allowed in a formula; use band letters, numbers, + - * / **, parentheses, "
                f"{', '.join(_FUNCTIONS)}"
            )


def _value(node: ast.expr, values: Mapping[str, FloatImage]) -> Any:
    match node:
        case ast.Name(id=name):
            return values[name]
        case ast.Constant(value=value):
            # float32 overflows to infinity; Python's integers would grow without limit, as in 9**9**9.
            return np.float32(value)  # type: ignore[arg-type]
        case ast.BinOp(left=left, op=op, right=right):
            return _OPERATORS[type(op)](_value(left, values), _value(right, values))
        case ast.UnaryOp(op=op, operand=operand):
            return _SIGNS[type(op)](_value(operand, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _FUNCTIONS[name](_value(argument, values))
    raise AssertionError(ast.dump(node))  # `_names` has refused it
