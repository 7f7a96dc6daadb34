"""Find the methods: every module of this package is looked at once, when somebody asks."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType

import pchem_pipeline.methods
from pchem_pipeline.methods.base import Method, registered


@functools.cache
def methods() -> Mapping[str, Method]:
    """Return every method by name, in the order of tables."""
    root = pchem_pipeline.methods
    for module in pkgutil.iter_modules(root.__path__, root.__name__ + "."):
        importlib.import_module(module.name)
    ordered = sorted(registered().items(), key=lambda item: (item[1].order, item[0]))
    return MappingProxyType({name: method() for name, method in ordered})
