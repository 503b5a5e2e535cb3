"""How many operations of floating-point a compiled loop holds, counted in its own source."""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable
from typing import Any

ARITHMETIC = (ast.Add, ast.Sub, ast.Mult, ast.Div)
INTEGERS = ("int32", "uint32", "int64", "uint64")
CALLS = ("min", "max", "sqrt", "log", "abs", "floor", "ceil")


@functools.cache
def operations_of(function: Callable[..., Any], integers: frozenset[str] = frozenset()) -> int:
    """Operations in a kernel's source, each as often as it is written there: the body of a loop counts once.

    One addition, subtraction, multiplication, division, comparison, minimum, maximum, square root, logarithm,
    absolute value or rounding counts one. What is not counted: arithmetic of constants, which the compiler does;
    what picks elements (subscripts); arithmetic of `integers` alone; choices (`a if b else c`); other kernels that
    it calls, which the caller adds.

    Args:
        function: a kernel, or a plain function.
        integers: names in it that hold no floating-point numbers; so does what is made a NumPy integer.
    """
    source = inspect.getsource(getattr(function, "py_func", function))
    return sum(_count(node, integers) for node in ast.parse(textwrap.dedent(source)).body)


def _count(node: ast.AST, integers: frozenset[str]) -> int:
    """Of a node and of what is below it."""
    if isinstance(node, ast.Subscript):
        return 0
    inside = sum(_count(child, integers) for child in ast.iter_child_nodes(node))
    return inside + _own(node, integers)


def _own(node: ast.AST, integers: frozenset[str]) -> int:
    if isinstance(node, ast.Compare):
        return 0 if _whole(node, integers) else len(node.ops)
    if isinstance(node, (ast.BinOp, ast.AugAssign)):
        return int(isinstance(node.op, ARITHMETIC) and not _whole(node, integers))
    if isinstance(node, ast.Call):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        return int(called in CALLS)
    return 0


def _whole(node: ast.AST, integers: frozenset[str]) -> bool:
    """Whether there are but constants (written as such, or in capitals) and integers in an expression."""
    if any(isinstance(part, ast.Subscript) for part in ast.walk(node)):
        return False
    if any(isinstance(part, ast.Attribute) and part.attr in INTEGERS for part in ast.walk(node)):
        return True
    names = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    return all(name in integers or name.isupper() for name in names)
