"""The mechanisms that `tools.ablate` disables exist, are used where they are replaced, and fit."""

from importlib import import_module
from inspect import signature
from types import FunctionType, ModuleType
from unittest.mock import patch

import pytest

from gateway.compiled import is_compiled
from tools.ablate import FILTER, MECHANISMS, Mechanism


def names_used_in(module: ModuleType) -> set[str]:
    """Return the names that the compiled functions of a module use."""
    own = (each for each in vars(module).values() if isinstance(each, FunctionType))
    functions = [each for each in own if each.__module__ == module.__name__]
    return {name for function in functions for name in function.__code__.co_names}


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda mechanism: mechanism.title)
def test_mechanism_is_used_in_its_module_and_its_replacement_fits(mechanism: Mechanism) -> None:
    _, module_name, name, replacement, _ = mechanism
    module = import_module(f"{FILTER}.{module_name}")
    original = getattr(module, name)
    # `filter` uses the functions of the other modules by these.
    assert name in names_used_in(module) | names_used_in(import_module(f"{FILTER}.filter"))
    if is_compiled(original):
        assert isinstance(replacement, FunctionType)
        assert is_compiled(replacement)
        signature(replacement).bind(*signature(original).parameters)
    else:
        assert type(replacement) is type(original)
    with patch.object(module, name, replacement):
        assert getattr(module, name) is replacement
    assert getattr(module, name) is original


def test_titles_are_unique() -> None:
    assert len({mechanism.title for mechanism in MECHANISMS}) == len(MECHANISMS)
