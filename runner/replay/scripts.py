"""The classes and functions of the script that recorded a run, without what else it does.

Imported are the script's modules; executed are its definitions that are needed, and the assignments that
these need. Loops, calls and the rest of the script are left out, so that nothing is retrained.
"""

from __future__ import annotations

import ast
import contextlib
import dis
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Final

from runner.errors import CannotRedo

MAIN: Final = "__main__"
"""The module in which the definitions of a script are."""
_script: tuple[str, str] = "", ""
"""Path and digest of the script that definitions may be taken from now."""
_PURE: Final = (
    "collections",
    "dataclasses",
    "enum",
    "fractions",
    "functools",
    "gymnasium",
    "itertools",
    "math",
    "numpy",
    "pathlib",
    "string",
    "types",
    "typing",
)
"""Modules that an assignment may use: what they give is known before the script runs."""
_OUTSIDE: Final = frozenset(["__import__", "eval", "exec", "input", "open"])
"""Functions that it may not."""
_DEFINITIONS: Final = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
_IMPORTS: Final = (ast.Import, ast.ImportFrom)


@contextlib.contextmanager
def script_of_run(path: str, digest: str) -> Iterator[None]:
    """Take definitions from a script while the block runs.

    Args:
        path: absolute; empty if there is no script.
        digest: SHA-256 of the script as it was when the run was recorded, in hexadecimal.
    """
    global _script  # noqa: PLW0603 - what needs it is called by foreign code
    before, _script = _script, (path, digest)
    try:
        yield
    finally:
        _script = before


def why_not_defined() -> str:
    """Return why there are no definitions of a script; empty if they can be tried."""
    path, digest = _script
    if not path:
        return (
            "The environment was defined in the script that recorded it, which is not known here: move it to "
            "a module, and name the function that makes it: make='module:function'."
        )
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        return f"The environment was defined in {path}, which cannot be read ({error.strerror})."
    if hashlib.sha256(data).hexdigest() != digest:
        return (
            f"The environment was defined in {path}, which has changed since it recorded the run: bring the "
            "earlier version back to make the environment again. In a module of its own it can be made from "
            "the version that is there."
        )
    return ""


def definition(name: str) -> object:
    """Return a class or function of the script.

    Raises:
        CannotRedo: there is no such script, it has changed, or the definition needs the rest of it.
    """
    if reason := why_not_defined():
        raise CannotRedo(reason)
    if name not in (defined := vars(_module(*_script, name))):
        raise CannotRedo(f"{name} is not defined at the top of {_script[0]}, the script that recorded it.")
    return defined[name]


@cache
def _module(path: str, _: str, name: str) -> ModuleType:
    """Return a module in which a name of a script is defined; the second argument is the script's digest."""
    tree = ast.parse(Path(path).read_bytes(), path)
    tree.body = _needed(tree.body, name)
    module = ModuleType(MAIN)
    module.__file__ = path
    exec(compile(tree, path, "exec"), vars(module))
    return module


def _needed(statements: list[ast.stmt], name: str) -> list[ast.stmt]:
    """Return all imports, the statements that define a name, and those which these need, in order.

    Raises:
        CannotRedo: what they need cannot be had without the rest of the script.
    """
    candidates = [statement for statement in statements if _only_defines(statement)]
    kept = {
        id(statement)
        for statement in candidates
        if any(isinstance(node, _IMPORTS) for node in ast.walk(statement))
    }
    needed: set[str] = set()
    todo = {name}
    while todo:
        needed |= todo
        kept |= {id(statement) for statement in candidates if not todo.isdisjoint(_bound(statement))}
        used = (_loaded(statement) for statement in candidates if id(statement) in kept)
        todo = set[str]().union(*used) - needed
    body = [statement for statement in statements if id(statement) in kept]
    rest = [statement for statement in statements if id(statement) not in kept]
    _require_constant(body, rest, needed, name)
    return body


def _require_constant(body: list[ast.stmt], rest: list[ast.stmt], needed: set[str], name: str) -> None:
    """Refuse definitions that use what is unknown before the script runs, or what its rest may change."""
    imported = {bound: top for statement in body for bound, top in _imported(statement).items()}
    assigned: set[str] = set()
    for assignment in body:
        if isinstance(assignment, (*_DEFINITIONS, *_IMPORTS)):
            continue
        for used in _loaded(assignment):
            if imported.get(used, "math") not in _PURE or used in _OUTSIDE:
                raise _refusal(name, f"{', '.join(sorted(_bound(assignment)))}, which it gets from {used}")
        assigned |= set() if _is_constant(assignment) else _bound(assignment)
    changed = set[str]().union(*map(_bound, rest), *(_loaded(part, "STORE_GLOBAL") for part in rest))
    for node in (node for statement in rest for node in ast.walk(statement)):
        if isinstance(node, ast.Attribute) and not isinstance(node.ctx, ast.Load):
            changed.add(ast.unparse(node.value))
        changed |= _handed_on(node) & assigned
    if alterable := changed & needed:
        raise _refusal(name, f"{', '.join(sorted(alterable))}, which the rest of the script may change")


def _refusal(name: str, what: str) -> CannotRedo:
    return CannotRedo(
        f"{name} was defined in the script that recorded it, and needs {what}. Move it to a module of its "
        "own, with what it needs as arguments."
    )


def _only_defines(statement: ast.stmt) -> bool:
    """Return whether a statement does nothing but import, define and assign names."""
    if isinstance(statement, ast.If | ast.Try):
        inner = [node for node in ast.iter_child_nodes(statement) if isinstance(node, ast.stmt)]
        handled = [node for handler in getattr(statement, "handlers", ()) for node in handler.body]
        return "__name__" not in _loaded(statement) and all(map(_only_defines, inner + handled))
    if isinstance(statement, ast.Assign | ast.AnnAssign | ast.AugAssign):
        targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
        return all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
    return isinstance(statement, (*_DEFINITIONS, *_IMPORTS, ast.Pass))


def _is_constant(statement: ast.stmt) -> bool:
    """Return whether a statement assigns a value that nothing can change."""
    value: ast.expr | None = getattr(statement, "value", None)
    if value is None:
        return False
    try:
        hash(ast.literal_eval(value))
    except (TypeError, ValueError):  # it can be changed, or is no literal
        return False
    return True


def _bound(node: ast.AST) -> set[str]:
    """Return the names that a statement defines or assigns in the module."""
    if isinstance(node, _DEFINITIONS):
        return {node.name}
    if isinstance(node, ast.alias):
        return {node.asname or node.name.partition(".")[0]}
    bound = {node.id} if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load) else set()
    return bound.union(*map(_bound, ast.iter_child_nodes(node)))


def _imported(statement: ast.stmt) -> dict[str, str]:
    """Return the top package of each name that a statement imports."""
    imports = [node for node in ast.walk(statement) if isinstance(node, _IMPORTS)]
    return {
        bound: ((node.module or ".") if isinstance(node, ast.ImportFrom) else alias.name).partition(".")[0]
        for node in imports
        for alias in node.names
        for bound in _bound(alias)
    }


def _handed_on(node: ast.AST) -> set[str]:
    """Return the names that are children of a node, unless it only reads an item of them."""
    if isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
        return set()
    return {child.id for child in ast.iter_child_nodes(node) if isinstance(child, ast.Name)}


def _loaded(statement: ast.stmt, operation: str = "LOAD_") -> set[str]:
    """Return the global names that a statement uses, also in functions that it defines."""
    todo = [compile(ast.Module([statement], []), "", "exec")]
    names = set()
    for code in todo:
        todo += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
        names |= {
            instruction.argval
            for instruction in dis.get_instructions(code)
            if instruction.opname.startswith(operation)
            and instruction.opname.endswith(("NAME", "GLOBAL", "GLOBALS"))
        }
    return names
