"""Compiled kernels, loaded when something is to be computed and not before; machine code is kept on disk by numba.

Modules whose names begin with an underscore and end in ``kernels`` hold nothing but kernels. They are imported through
`kernels` only, so that importing mapfuse costs no numba.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

log = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Decorator: compiled at its first call, without the interpreter's lock, and cached on disk where that is writable.

    Numba keeps the machine code beside the source, or in the user's cache folder, or in ``NUMBA_CACHE_DIR``. Where none
    of them can be written, each process compiles anew.
    """
    return _compiled(function)


def inlined(function: Function) -> Function:
    """Decorator: a `kernel` that becomes a part of those that call it, wherever a call would cost as much as its work.

    An array is handed over as seven numbers, and the compiler's own choice changes with details of the source.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: Function, forceinline: bool = False) -> Function:
    import numba

    compiled: Any
    try:
        compiled = numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=forceinline)(function)
    except RuntimeError:  # numba's word for: there is no folder to keep it in
        compiled = numba.njit(nogil=True, error_model="numpy", forceinline=forceinline)(function)
    return cast(Function, compiled)


@cache
def kernels(name: str, package: str | None, what: str) -> ModuleType:
    """The module ``name`` of a package; says once that ``what`` will be compiled, if it isn't on disk yet."""
    module = import_module(f"{package}.{name}")
    current, outdated = _on_disk(module)
    for index in outdated:
        with suppress(OSError):
            index.unlink()
    if not current:
        log.warning("compiling %s for this machine, once; it takes some seconds", what)
    return module


def _on_disk(module: ModuleType) -> tuple[list[Path], list[Path]]:
    """Indices of the machine code that numba has kept of this version of the module's source, and of earlier ones.

    Numba would read an earlier one before it finds it outdated, and fail where that names a class which is gone.
    """
    source = Path(str(module.__file__))
    folders = {value.stats.cache_path for value in vars(module).values() if hasattr(value, "py_func")}
    kept = [index for folder in folders if folder for index in Path(folder).glob(f"{source.stem}.*.nbi")]
    current = [index for index in kept if index.stat().st_mtime >= source.stat().st_mtime]
    return current, [index for index in kept if index not in current]
