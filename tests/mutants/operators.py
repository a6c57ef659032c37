"""The faults: each place of a module's code that one can be planted at, with the ways to do it.

Nothing is changed in docstrings and other strings, annotations, messages of errors and asserts, and imports.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass

Step = tuple[str, int | None]
Path = tuple[Step, ...]

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt, ast.GtE),
    ast.Gt: (ast.GtE, ast.LtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_CALCULATED: dict[type[ast.operator], tuple[type[ast.operator], ...]] = {
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.Div: (ast.Mult,),
    ast.FloorDiv: (ast.Mult, ast.Mod),
    ast.Mod: (ast.FloorDiv,),
    ast.Pow: (ast.Mult,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.BitXor: (ast.BitAnd,),
}
_OPPOSITE = {"min": "max", "minimum": "maximum", "amin": "amax", "argmin": "argmax", "nanmin": "nanmax"}
_OPPOSITE |= {most: least for least, most in _OPPOSITE.items()}
_AXES = ("axis", "dim")
_ARRAYS = ("np.ndarray", "Tensor", "Array", "Values")


@dataclass(frozen=True)
class Fault:
    """One way to change the code at a place: by which operator, what is put there, and what one reads of it."""

    operator: str
    path: Path
    new: ast.AST
    before: str
    after: str

    def shown(self, source: str, most: int = 110) -> str:
        """The first line of the statement, with before -> after in brackets, cut to what is around them."""
        tree: ast.AST = ast.parse(source)
        statement, parent = tree, tree
        for name, index in self.path:
            parent, tree = tree, getattr(tree, name) if index is None else getattr(tree, name)[index]
            statement = tree if isinstance(tree, ast.stmt) else statement
        mark = ast.Name(f"[{_line(self.before)} -> {_line(self.after)}]", ast.Load())
        if tree is statement:
            return mark.id
        name, index = self.path[-1]
        if index is None:
            setattr(parent, name, mark)
        else:
            getattr(parent, name)[index] = mark
        text = next(line for line in ast.unparse(statement).splitlines() if mark.id in line)
        at = text.index(mark.id)
        room = max(0, most - len(mark.id)) // 2
        first, last = max(0, at - room), at + len(mark.id) + room
        return ("..." * (first > 0) + text[first:last].strip() + "..." * (last < len(text))).replace("|", "¦")


@dataclass(frozen=True)
class Site:
    """A place in the code: the function that it is in, the lines of its statement, and its faults."""

    function: str
    lines: tuple[int, int]
    line: int
    faults: tuple[Fault, ...]


def planted(source: str, fault: Fault) -> ast.Module:
    """The module with the fault in it."""
    tree = ast.parse(source)
    node: ast.AST = tree
    for name, index in fault.path[:-1]:
        node = getattr(node, name) if index is None else getattr(node, name)[index]
    name, index = fault.path[-1]
    old = getattr(node, name) if index is None else getattr(node, name)[index]
    new = ast.copy_location(deepcopy(fault.new), old)
    if index is None:
        setattr(node, name, new)
    else:
        getattr(node, name)[index] = new
    return ast.fix_missing_locations(tree)


def sites(source: str) -> list[Site]:
    """All places of a module, in the order of the code."""
    return list(_Walk(source).module())


class _Walk:
    def __init__(self, source: str):
        self._tree = ast.parse(source)

    def module(self) -> Iterator[Site]:
        yield from self._body(self._tree, (), "", "")

    def _body(self, node: ast.AST, path: Path, function: str, returns: str) -> Iterator[Site]:
        """Sites of the statements below a node, and of what the node itself evaluates."""
        assigned = _parameters(node)
        for name, value in ast.iter_fields(node):
            if (
                isinstance(value, list)
                and value
                and isinstance(value[0], ast.stmt | ast.excepthandler | ast.match_case)
            ):
                for i, statement in enumerate(value):
                    yield from self._statement(statement, (*path, (name, i)), function, returns, assigned)
                    assigned |= _targets(statement)

    def _statement(self, node: ast.AST, path: Path, function: str, returns: str, assigned: set[str]) -> Iterator[Site]:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return
        if isinstance(node, ast.Import | ast.ImportFrom):
            return
        lines = _lines(node)
        faults = _deleted(node, path, assigned)
        if faults:
            yield Site(function, lines, lines[0], faults)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            function = f"{function}.{node.name}".lstrip(".")
            if isinstance(node, ast.FunctionDef):
                returns = ast.unparse(node.returns) if node.returns else ""
        for child, at in _expressions(node, path):
            yield from self._expression(child, at, node, function, lines, returns)
        yield from self._body(node, path, function, returns)

    def _expression(
        self, node: ast.AST, path: Path, parent: ast.AST, function: str, lines: tuple[int, int], returns: str
    ) -> Iterator[Site]:
        if isinstance(node, ast.JoinedStr):
            return
        faults = tuple(_faults(node, path, parent, returns))
        if faults:
            at = getattr(node, "lineno", lines[0])
            yield Site(function, (min(lines[0], at), max(lines[1], at)), at, faults)
        if isinstance(node, ast.UnaryOp) and isinstance(node.operand, ast.Constant):
            return  # the minus of a number goes with the number
        if isinstance(node, ast.keyword) and node.arg in _AXES:
            return
        for child, at in _children(node, path):
            yield from self._expression(child, at, node, function, lines, returns)


def _children(node: ast.AST, path: Path) -> Iterator[tuple[ast.AST, Path]]:
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "ctx", "op", "ops"):
            continue
        if isinstance(value, ast.AST):
            yield value, (*path, (name, None))
        elif isinstance(value, list):
            yield from ((v, (*path, (name, i))) for i, v in enumerate(value) if isinstance(v, ast.AST))


def _expressions(node: ast.AST, path: Path) -> Iterator[tuple[ast.AST, Path]]:
    """What a statement evaluates itself: not the statements in its body, and no message."""
    if isinstance(node, ast.Raise):
        return
    for child, at in _children(node, path):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            continue
        if isinstance(node, ast.Assert) and at[-1][0] == "msg":
            continue
        yield child, at


def _lines(node: ast.AST) -> tuple[int, int]:
    """First and last line of what a statement evaluates itself."""
    first = getattr(node, "lineno", None) or min(n.lineno for n in ast.walk(node) if hasattr(n, "lineno"))
    own = [e for e, _ in _expressions(node, ())] if hasattr(node, "body") else [node]
    return first, max([first, *(n.end_lineno for e in own for n in ast.walk(e) if getattr(n, "end_lineno", None))])


def _parameters(node: ast.AST) -> set[str]:
    return (
        {n.arg for n in ast.walk(node.args) if isinstance(n, ast.arg)} if isinstance(node, ast.FunctionDef) else set()
    )


def _targets(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def _line(code: str, most: int = 70) -> str:
    line = " ".join(code.split()).replace("|", "¦")
    return line if len(line) <= most else f"{line[: most - 3]}..."


def _fault(operator: str, path: Path, old: ast.AST, new: ast.AST) -> Fault:
    after = "nothing" if isinstance(new, ast.Pass) else ast.unparse(new)
    return Fault(operator, path, new, ast.unparse(old), after)


def _deleted(node: ast.AST, path: Path, assigned: set[str]) -> tuple[Fault, ...]:
    """A statement left out, where it does more than give a first value to a name, which would only miss it."""
    if isinstance(node, ast.Assign):
        names = [t for target in node.targets for t in (target.elts if isinstance(target, ast.Tuple) else [target])]
        gone = all(not isinstance(t, ast.Name) or t.id in assigned for t in names)
    else:
        gone = isinstance(node, ast.AugAssign | ast.Raise | ast.Break | ast.Continue | ast.Delete) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        )
    faults = (_fault("statement deleted", path, node, ast.Pass()),) if gone else ()
    if isinstance(node, ast.AugAssign):
        others = _CALCULATED.get(type(node.op), ())
        faults += tuple(
            _fault("arithmetic", path, node, ast.AugAssign(node.target, kind(), node.value)) for kind in others
        )
    return faults


def _faults(node: ast.AST, path: Path, parent: ast.AST, returns: str) -> Iterator[Fault]:
    if isinstance(parent, ast.Return):
        yield _fault("value returned", path, node, _instead(node, returns))
    if isinstance(parent, ast.If | ast.IfExp | ast.While) and path[-1][0] == "test" and _plain(node):
        yield _fault("condition turned", path, node, ast.UnaryOp(ast.Not(), node))
    if isinstance(parent, ast.Subscript) and path[-1][0] == "slice" and isinstance(node, ast.Name):
        yield _fault("index", path, node, ast.BinOp(node, ast.Add(), ast.Constant(1)))
    match node:
        case ast.Compare():
            for i, op in enumerate(node.ops):
                for other in _COMPARED[type(op)]:
                    ops = [*node.ops[:i], other(), *node.ops[i + 1 :]]
                    yield _fault("comparison", path, node, ast.Compare(node.left, ops, node.comparators))
        case ast.BoolOp():
            other = ast.Or() if isinstance(node.op, ast.And) else ast.And()
            yield _fault("and/or", path, node, ast.BoolOp(other, node.values))
        case ast.BinOp():
            for kind in _CALCULATED.get(type(node.op), ()):
                yield _fault("arithmetic", path, node, ast.BinOp(node.left, kind(), node.right))
        case ast.UnaryOp():
            yield _fault("sign or not", path, node, node.operand)
            if isinstance(node.operand, ast.Constant):
                for value in _numbers(-node.operand.value):
                    yield _fault("constant", path, node, ast.Constant(value))
        case ast.Constant(value=bool()):
            yield _fault("True/False", path, node, ast.Constant(not node.value))
        case ast.Constant(value=int() | float()):
            for value in _numbers(node.value):
                yield _fault("constant", path, node, ast.Constant(value))
        case ast.Call(func=ast.Name(id=name)) if name in _OPPOSITE:
            yield _fault(
                "min/max", path, node, ast.Call(ast.Name(_OPPOSITE[name], ast.Load()), node.args, node.keywords)
            )
        case ast.Call(func=ast.Attribute(attr=name, value=value)) if name in _OPPOSITE:
            called = ast.Attribute(value, _OPPOSITE[name], ast.Load())
            yield _fault("min/max", path, node, ast.Call(called, node.args, node.keywords))
        case ast.keyword(arg=name) if name in _OPPOSITE:
            yield _fault("min/max", path, node, ast.keyword(_OPPOSITE[name], node.value))
        case ast.keyword(arg=name) if name in _AXES:
            for value in (-1, -2, 0):
                if ast.unparse(node.value) != str(value):
                    yield _fault("axis", path, node, ast.keyword(name, ast.Constant(value)))
        case ast.Slice():
            for bound in ("lower", "upper"):
                old = getattr(node, bound)
                if old is not None:
                    for new in (None, ast.BinOp(old, ast.Add(), ast.Constant(1))):
                        yield _fault("slice", path, node, ast.Slice(**{**dict(ast.iter_fields(node)), bound: new}))


def _plain(node: ast.AST) -> bool:
    """Whether a condition has no comparison, no `and` and no `not` of its own to be changed."""
    return not isinstance(node, ast.Compare | ast.BoolOp | ast.UnaryOp)


def _numbers(value: float) -> list[float]:
    found: list[float] = []
    for other in (value + 1, value - 1, 2 * value, 0 * value):
        if other != value and other not in found:
            found.append(other)
    return found


def _instead(node: ast.expr, returns: str) -> ast.expr:
    """Another value of the type that is returned, or None."""
    if returns == "bool":
        return ast.UnaryOp(ast.Not(), node)
    if returns in ("int", "float"):
        return ast.BinOp(node, ast.Add(), ast.Constant(1))
    if returns in _ARRAYS:
        return ast.BinOp(ast.Constant(0), ast.Mult(), node)
    return ast.Constant("mutant" if returns == "str" else None)
