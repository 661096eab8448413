"""The doors of the library: arguments have the types of their signatures, or one line names the wrong one.

Types that a module names for type checkers alone are known by their names: of a class that is not loaded
there is no instance.
"""

from __future__ import annotations

import builtins
import functools
import inspect
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from numbers import Integral, Real
from typing import Annotated, Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from v2hdm.errors import ConfigError, shown
from v2hdm.settings import Within

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Class = TypeVar("_Class", bound=type[Any])

_WORDS = {str: "a text", int: "a whole number", float: "a number", bool: "True or False", type(None): "None"}


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """``function`` behind a check of its arguments' types; ConfigError names the one that differs."""
    signature = inspect.signature(function)
    where = function.__qualname__.removesuffix(".__init__")
    names = tuple(signature.parameters)
    kinds = {parameter.kind for parameter in signature.parameters.values()}
    takes_any = bool(kinds & {inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD})

    @functools.wraps(function)
    def door(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if takes_any or len(args) > len(names):
            arguments: Mapping[str, Any] = signature.bind(*args, **kwargs).arguments
        else:  # what does not belong to the signature the call itself refuses
            arguments = dict(zip(names, args, strict=False)) | kwargs
        tests = _tests(function)
        for name, value in arguments.items():
            if name in tests and not tests[name](value):
                _check(value, _hints(function)[name], f"{where}: {name}")
        return function(*args, **kwargs)

    return door


def checked_class(kind: _Class) -> _Class:
    """``kind``, whose instances are made of what its fields state; as :func:`checked`."""
    kind.__init__ = checked(kind.__init__)
    return kind


def check_types(options: Any, prefix: str = "") -> None:
    """Raise ConfigError, which names ``prefix`` and the key, for settings of another type than theirs."""
    for name, (fits, kind) in _tests_of_fields(type(options).__init__).items():
        value = getattr(options, name)
        is_nested = is_dataclass(value)
        if fits(value) and not is_nested:
            continue
        dot = "" if not prefix or prefix.endswith(".") else "."
        where = f"{prefix}{dot}{name}"
        _check(value, kind, where)
        if is_nested:
            check_types(value, where)


@functools.cache
def _tests_of_fields(init: Callable[..., None]) -> Mapping[str, tuple[Callable[[Any], bool], Any]]:
    """Test and type of each field of a dataclass, of its making; ranges are another check."""
    kinds = {
        name: get_args(hint)[0] if get_origin(hint) is Annotated else hint
        for name, hint in _hints(init).items()
        if name != "return"
    }
    return {name: (_test_of(kind), kind) for name, kind in kinds.items()}


def _check(value: object, hint: Any, where: str) -> None:
    if not _fits(value, hint):
        raise ConfigError(f"{where} is {_shown(value)}: give {_words(hint)}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether ``value`` has the type ``hint``; iterators are not consumed to find out."""
    return _test_of(hint)(value)


@functools.cache
def _test_of(hint: Any) -> Callable[[Any], bool]:
    """The test of a type: a problem of the adjustment, made for each marking, has twenty fields to test."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return lambda value: True
    if origin is Annotated:
        kind = _test_of(parts[0])
        allowed = [note for note in parts[1:] if isinstance(note, Within)]
        return lambda value: (
            kind(value)
            and (not isinstance(value, Real) or all(within.holds(float(value)) for within in allowed))
        )
    if origin in (Union, types.UnionType):
        tests = [_test_of(part) for part in parts]
        return lambda value: any(test(value) for test in tests)
    if origin is None:
        return lambda value: _is_one(value, hint)
    if origin is np.ndarray:
        return lambda value: isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    return lambda value: _holds(value, origin, parts)


def _holds(value: Any, origin: Any, parts: Sequence[Any]) -> bool:
    """Whether ``value`` is a container of the type ``origin`` with entries of the types ``parts``."""
    if not isinstance(value, origin) or isinstance(value, str | bytes):
        return False
    if origin is Iterable and isinstance(value, Mapping | np.ndarray):
        return False
    if isinstance(value, Mapping):
        return all(_fits(key, parts[0]) and _fits(entry, parts[1]) for key, entry in value.items())
    if origin is tuple and parts[-1:] != (...,):
        return len(value) == len(parts) and all(map(_fits, value, parts))
    if isinstance(value, list | tuple) and issubclass(origin, Iterable):
        return all(_fits(entry, parts[0]) for entry in value)
    return True


def _is_one(value: object, kind: Any) -> bool:
    """Whether ``value`` is one of a class; NumPy's numbers are, and True is no number."""
    if kind is None:
        return value is None
    is_truth = isinstance(value, bool | np.bool_)
    if kind is bool:
        return is_truth
    if kind in (int, float):
        return isinstance(value, Integral if kind is int else Real) and not is_truth
    return isinstance(value, kind)


def _shown(value: object) -> str:
    if value is None or isinstance(value, bool):
        return str(value)
    if isinstance(value, str | int | float | list | tuple | dict):
        return shown(value)
    return f"of the type {type(value).__name__}"


def _words(hint: Any) -> str:
    """A type as a reader calls it."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin is Annotated:
        ranges = [str(note) for note in parts[1:] if isinstance(note, Within)]
        return f"{_words(parts[0])}, {ranges[0]}" if ranges and ranges[0] else _words(parts[0])
    if origin in (Union, types.UnionType):
        *most, last = dict.fromkeys(_words(part) for part in parts)
        return f"{', '.join(most)} or {last}" if most else last
    if hint in _WORDS:
        return _WORDS[hint]
    if origin is Callable or hint is Callable:
        return "a function"
    if origin is np.ndarray:
        return "an array of numbers"
    if origin is not None and issubclass(origin, Mapping):
        return f"a dict with {_words(parts[1])} by {_words(parts[0])}"
    if origin is not None and issubclass(origin, Iterable):
        return f"a {'tuple' if origin is tuple else 'list'} of {_words(parts[0])}"
    return f"a {getattr(origin or hint, '__name__', hint)}"


class _ByName(type):
    """The type of a class that is known by its name alone."""

    def __instancecheck__(cls, instance: object) -> bool:
        return any(
            base.__name__ == cls.__name__ and base.__module__.startswith("v2hdm.")
            for base in type(instance).__mro__
        )


class _Names(dict[str, Any]):
    """The names of annotations: those of their module, others by their names alone."""

    def __init__(self, module: Mapping[str, Any]) -> None:
        super().__init__()
        self._module = module

    def __missing__(self, name: str) -> Any:
        if name in self._module:
            return self._module[name]
        return vars(builtins)[name] if hasattr(builtins, name) else _ByName(name, (), {})


@functools.cache
def _tests(function: Callable[..., Any]) -> Mapping[str, Callable[[Any], bool]]:
    """The tests of a function's arguments, by their names."""
    return {name: _test_of(hint) for name, hint in _hints(function).items()}


@functools.cache
def _hints(function: Callable[..., Any]) -> Mapping[str, Any]:
    """The annotations of a function, or of the making of a dataclass."""
    module: Mapping[str, Any] = function.__globals__
    return get_type_hints(function, None, _Names(module), include_extras=True)
