"""The arguments with which an environment, a game or a wrapper was made, read from the object."""

from __future__ import annotations

import ast
import dis
import inspect
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pkgutil import resolve_name
from typing import Any, Final

import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.utils import EzPickle, RecordConstructorArgs
from gymnasium.wrappers import HumanRendering, OrderEnforcing, PassiveEnvChecker, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import HumanRendering as VectorHumanRendering
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo

from runner.environments.interfaces import class_name, creator_of, name_of
from runner.recording.maker import FUNCTION_NAME
from runner.replay.scripts import MAIN
from runner.replay.trust import is_left_out
from runner.util.values import MAX_TEXT, Json

_SHOWN: Final = "render_mode"
"""A parameter that changes no step."""
_COPIES: Final = frozenset({"bool", "dict", "float", "int", "list", "str", "tuple"})
"""Functions that copy: an argument and its copy make the same object."""
VARIABLE: Final = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
_UNKNOWN: Final = object()


class CannotBeMade(Exception):
    """Why a part of the environment cannot be made again."""


def arguments_of(made: object, inner: str = "") -> tuple[Json, bool]:
    """Return the keyword arguments with which an object was made, and whether all are certain.

    They are certain where the constructor records them, by `RecordConstructorArgs` or `EzPickle`, or keeps
    each unchanged in an attribute that nothing else in the class sets. An attribute with the name of a
    parameter, or else the default, is likely, but not certain.

    Args:
        inner: the parameter for the wrapped environment, which is left out; empty if there is none.

    Raises:
        CannotBeMade: an argument is unknown and has no default.
    """
    kind: Any = type(made)
    parameters = inspect.signature(kind).parameters
    recorded = _recorded(made, parameters)
    kept = _kept(kind)
    kwargs = dict(recorded)
    is_certain = True
    if inner and inner not in parameters:
        raise CannotBeMade(f"{class_name(made)} does not record its arguments: it has no parameter {inner}")
    for name, parameter in parameters.items():
        if name in (inner, _SHOWN) or name in recorded:
            continue
        if parameter.kind in VARIABLE:
            is_certain = is_certain and bool(recorded)
            continue
        names = (kept[name],) if name in kept else (name, f"_{name}")
        values = (getattr(made, attribute, _UNKNOWN) for attribute in names)
        value = next((value for value in values if name in kept or is_plain(value)), _UNKNOWN)
        if value is parameter.default and not is_plain(value):
            continue
        is_certain = is_certain and name in kept
        if value is not _UNKNOWN:
            kwargs[name] = value
        elif parameter.default is parameter.empty:
            raise CannotBeMade(f"{class_name(made)} does not record its arguments: {name} is unknown")
    return {name: value for name, value in kwargs.items() if name not in (inner, _SHOWN)}, is_certain


def _recorded(made: Any, parameters: Mapping[str, inspect.Parameter]) -> Json:
    """Return the arguments that an object's own constructor records, not only a base class's."""
    names = getattr(getattr(inspect.unwrap(type(made).__init__), "__code__", None), "co_names", ())
    arguments: Json = {}
    if "RecordConstructorArgs" in names and isinstance(made, RecordConstructorArgs):
        arguments = made._saved_kwargs
    elif "EzPickle" in names and isinstance(made, EzPickle):
        arguments = dict(zip(parameters, made._ezpickle_args, strict=False)) | made._ezpickle_kwargs
    kinds = {parameter.kind for parameter in parameters.values()}
    is_complete = inspect.Parameter.VAR_KEYWORD in kinds or arguments.keys() <= parameters.keys()
    return arguments if is_complete and inspect.Parameter.VAR_POSITIONAL not in kinds else {}


@cache
def _kept(kind: type[Any]) -> dict[str, str]:
    """Return the attribute in which a constructor keeps a parameter unchanged, by parameter."""
    constructor = kind.__init__
    try:
        function = ast.parse(textwrap.dedent(inspect.getsource(constructor))).body[0]
    except (OSError, TypeError, SyntaxError):  # it is in no file, or not written in Python
        return {}
    if not isinstance(function, ast.FunctionDef) or function.decorator_list or not function.args.args:
        return {}
    itself = function.args.args[0].arg
    stored = Counter(
        node.id if isinstance(node, ast.Name) else f".{node.attr}"
        for node in ast.walk(function)
        if isinstance(node, ast.Name | ast.Attribute) and not isinstance(node.ctx, ast.Load)
    )
    kept: dict[str, str] = {}
    for target, value in (pair for statement in function.body for pair in _assigned(statement)):
        if isinstance(value, ast.Call) and ast.unparse(value.func) in _COPIES and len(value.args) == 1:
            value = value.args[0]  # noqa: PLW2901 - what is copied
        if isinstance(value, ast.Name) and isinstance(target, ast.Attribute):
            is_own = ast.unparse(target.value) == itself and stored[f".{target.attr}"] == 1
            if is_own and not stored[value.id]:
                kept[value.id] = target.attr
    members = (member for base in kind.__mro__ for member in vars(base).values() if member is not constructor)
    methods = (inspect.unwrap(member) for member in members if inspect.isfunction(member))
    changed = {
        instruction.argval
        for method in filter(inspect.isfunction, methods)
        if not set(kept.values()).isdisjoint(method.__code__.co_names)
        for instruction in dis.get_instructions(method)
        if instruction.opname == "STORE_ATTR"
    }
    return {name: attribute for name, attribute in kept.items() if attribute not in changed}


def _assigned(statement: ast.stmt) -> Iterator[tuple[ast.expr, ast.expr | None]]:
    """Yield each target of an assignment with its value, also of several at once."""
    if isinstance(statement, ast.AnnAssign):
        yield statement.target, statement.value
    elif isinstance(statement, ast.Assign):
        for target in statement.targets:
            if isinstance(target, ast.Tuple) and isinstance(statement.value, ast.Tuple):
                yield from zip(target.elts, statement.value.elts, strict=False)
            else:
                yield target, statement.value


def plain_kwargs(kwargs: Mapping[str, object], owner: str) -> Json:
    """Return keyword arguments that JSON can hold.

    Raises:
        CannotBeMade: it cannot hold one.
    """
    for name, value in kwargs.items():
        if not is_plain(value):
            raise CannotBeMade(
                f"{owner} has the argument {name}, of {class_name(value)}, which JSON cannot hold"
            )
    return dict(kwargs)


def is_plain(value: object) -> bool:
    """Return whether JSON can hold a value, with `plain_number` for the numbers of NumPy."""
    try:
        return _is_plain(value)
    except RecursionError:
        return False


def _is_plain(value: object) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(part) for key, part in value.items())
    return value is None or isinstance(value, str | int | float | np.number | np.bool_)


def plain_number(value: np.generic) -> object:
    """Return a number of NumPy as JSON holds it."""
    return value.item()


def factory_of(made: Any) -> tuple[str, Json, bool]:
    """Return the function of a module that made an object, its arguments, and whether all are certain.

    It is known by a function or class that was defined in it and given to the object, and its arguments by
    the variables which that uses.

    Raises:
        CannotBeMade: there is none, or an argument is unknown and has no default.
    """
    kind: Any = type(made)
    given = (getattr(made, attribute, None) for attribute in _kept(kind).values())
    for local in given:
        name, is_local, _ = getattr(local, "__qualname__", "").partition(".<locals>")
        function = getattr(sys.modules.get(getattr(local, "__module__", "")), name, None)
        if is_local and inspect.isfunction(function):
            break
    else:
        raise CannotBeMade(f"the wrapper {class_name(made)} does not record its arguments")
    path = f"{function.__module__}:{name}"
    _, *parameters = inspect.signature(function).parameters.values()
    methods = vars(local).values() if isinstance(local, type) else [local]
    cells = {
        variable: cell
        for method in filter(inspect.isfunction, methods)
        for variable, cell in zip(method.__code__.co_freevars, method.__closure__ or (), strict=True)
    }
    kwargs = {
        parameter.name: cells[parameter.name].cell_contents
        for parameter in parameters
        if parameter.name in cells
    }
    if any(parameter.default is parameter.empty for parameter in parameters if parameter.name not in cells):
        raise CannotBeMade(f"{path} does not record its arguments")
    changed = {
        instruction.argval
        for instruction in dis.get_instructions(function)
        if instruction.opname == "STORE_DEREF"
    }
    is_certain = len(kwargs) == len(parameters) and changed.isdisjoint(kwargs)
    return path, plain_kwargs(kwargs, path), is_certain


_SHOWS_ONLY: Final = (RecordVideo, HumanRendering, VectorRecordVideo, VectorHumanRendering)
"""Wrappers that only show or store pictures: left out when the environment is made again."""
OBSERVERS: Final = frozenset(
    {
        "sb3_contrib.common.wrappers.action_masker:ActionMasker",
        "stable_baselines3.common.monitor:Monitor",
        "stable_baselines3.common.atari_wrappers:AtariWrapper",  # puts the other ones together
    }
)
"""Wrappers of Stable-Baselines3 that themselves change no observation, reward or end: left out, too."""


def wrappers_as_fields(wrappers: Sequence[Any], spec: object, assumed: list[str]) -> Json:
    """Return the fields of an `EnvSpec` that describe wrappers, given from the innermost out.

    Wrappers that the entry point itself puts around its environment are only counted: it does so again. The
    wrappers that `gymnasium.make` adds next are fields of their own.
    """
    left = list(wrappers)
    inner = 0
    if isinstance(spec, EnvSpec) and not isinstance(creator_of(spec), type):
        checkers = (PassiveEnvChecker, OrderEnforcing)
        firsts = [number for number, wrapper in enumerate(left) if type(wrapper) in checkers]
        if firsts:
            inner = firsts[0]
        else:  # both were left out, or only an inner environment is recorded
            assumed.append(name_of(spec.entry_point))
    del left[:inner]
    checker = left.pop(0) if left and type(left[0]) is PassiveEnvChecker else None
    order = left.pop(0) if left and type(left[0]) is OrderEnforcing else None
    limit = left.pop(0) if left and type(left[0]) is TimeLimit else None
    return {
        "inner_wrappers": inner,
        "disable_env_checker": checker is None,
        "order_enforce": order is not None,
        "max_episode_steps": None if limit is None else limit._max_episode_steps,
        "additional_wrappers": [wrapper_fields(wrapper, assumed) for wrapper in left],
    }


def only_observes(wrapper: object) -> bool:
    """Return whether a wrapper changes nothing that is recorded, and can be left out."""
    return isinstance(wrapper, _SHOWS_ONLY) or class_name(wrapper) in OBSERVERS


def declared_wrapper_fields(spec: WrapperSpec, assumed: list[str]) -> Json:
    """Return the fields of a wrapper's specification, which has no arguments if it does not record them."""
    if spec.kwargs is None:
        parameters = inspect.signature(resolve_name(spec.entry_point)).parameters.values()
        others = [parameter for parameter in parameters if parameter.name != "env"]
        if any(other.default is other.empty for other in others if other.kind not in VARIABLE):
            raise CannotBeMade(f"the wrapper {spec.entry_point} does not record its arguments")
        if others:
            assumed.append(spec.entry_point)
    kwargs = plain_kwargs(spec.kwargs or {}, f"the wrapper {spec.entry_point}")
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": kwargs}


def wrapper_fields(wrapper: object, assumed: list[str]) -> Json:
    """Return the fields of a `WrapperSpec`; add the wrapper to `assumed` if its arguments are unknown."""
    name = class_name(wrapper)
    kwargs, is_certain = arguments_of(wrapper, "env")
    if not is_certain and not is_left_out(name):
        assumed.append(name)
    kwargs = plain_kwargs(kwargs, f"the wrapper {name}")
    return {"name": type(wrapper).__name__, "entry_point": entry_point_of(type(wrapper)), "kwargs": kwargs}


def game_wrapper_fields(wrapper: object, assumed: list[str]) -> Json:
    """Return what makes a wrapper around a game: a class, or a function as SuperSuit has them."""
    name = class_name(wrapper)
    try:
        kwargs, is_certain = arguments_of(wrapper, "env")
        entry_point, kwargs = entry_point_of(type(wrapper)), plain_kwargs(kwargs, f"the wrapper {name}")
    except CannotBeMade:
        entry_point, kwargs, is_certain = factory_of(wrapper)
    if not is_certain:
        assumed.append(name)
    return {"entry_point": entry_point, "kwargs": kwargs}


def entry_point_of(value: object) -> str:
    """Return the `module:name` from which `gymnasium.make` gets a class or function.

    Raises:
        CannotBeMade: it cannot be imported by such a name.
    """
    text = name_of(value)
    module, _, name = text.partition(":")
    is_there = isinstance(value, str) or getattr(sys.modules.get(module), name, None) is value
    if not is_there or not FUNCTION_NAME.fullmatch(text) or "." in name:
        raise CannotBeMade(f"{text} cannot be imported by name"[:MAX_TEXT])
    if module == MAIN and not getattr(sys.modules[MAIN], "__file__", None):
        raise CannotBeMade(f"{text} is defined in no file")
    return text
