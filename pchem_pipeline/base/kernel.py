"""Compiled loops: one decorator, one error model, one cache on disk.

A kernel that other kernels call is translated, but neither optimised nor turned into machine code by itself:
the kernel that Python calls is optimised once, with all that it calls. numba's own way is to optimise and to
emit every kernel at every level of calls and to wrap each for Python twice: twice the time for the same code.
"""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from typing import Any

import numba
from numba import _dynfunc
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, DefaultPassBuilder, _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.datamodel import register_default
from numba.core.datamodel.models import OpaqueModel
from numba.core.imputils import lower_constant
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import NativeLowering

from pchem_pipeline.base.kernel_cache import TIGHT_MEMORY, KernelCache, values_of_closure


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    inline: bool = False,
    borrows: bool = False,
    views: bool = False,
) -> Any:
    """Compile a loop when it is first called.

    Division by zero gives infinity or NaN as in numpy, never an exception, so that loops vectorise; no kernel
    reorders sums (``fastmath``), so that its bits do not depend on who compiled it. The interpreter's lock is
    released while it runs.

    Args:
        function: of scalars and arrays.
        inline: have LLVM put the code into its callers however long it is: a record of arrays is dozens of
            words to pass.
        borrows: all its arrays are its callers': it makes none and returns none. Then references are not
            counted, an atomic operation for each array, each part of one and each call, which takes a fourth
            of the time of loops as short as those of the fit.
        views: it returns parts of its arrays, also to kernels that borrow: numba puts its code into each
            caller, which takes many times as long to compile.
    """
    if function is None:
        return lambda function: kernel(function, inline=inline, borrows=borrows, views=views)
    if numba.config.DISABLE_JIT:
        return function
    _name_apart(function)
    options = {
        "nopython": True,
        "nogil": True,
        "error_model": "numpy",
        "inline": "always" if views else "never",
        "forceinline": inline,
        "no_cfunc_wrapper": True,
        **({"_nrt": False} if borrows else {}),
    }
    return _Kernel(function, options)


def callback(
    function: Callable[..., Any], result: Any, arguments: tuple[Any, ...], *, borrows: bool = False
) -> Any:
    """Compile a function at once, for kernels that are given it and call it by its address.

    A kernel has the code of all kernels that it calls by name in it. What it is given is compiled by itself,
    once for all of them, and the others need not wait for it: of several such functions only those that are
    asked for are compiled. A call costs some nanoseconds.

    Args:
        function: of scalars, arrays and named tuples of them.
        result: type of its answer (of numba).
        arguments: an example of each of its arguments, or their types.
        borrows: see :func:`kernel`; what it calls by name must return no array, or be inlined.
    """
    if numba.config.DISABLE_JIT:
        return function
    _name_apart(function)
    kinds = tuple(types_of(arguments)), result
    compiled = CFunc(
        function, kinds, locals={}, options={"error_model": "numpy", **({"_nrt": False} if borrows else {})}
    )
    compiled._cache = _CallbackCache(function)  # type: ignore[attr-defined]
    with _uncollected():
        compiled.compile()
    return compiled


def _name_apart(function: Callable[..., Any]) -> None:
    """Name a function after what its maker was given.

    Of two machine codes with one name only the first that is loaded is run, and numba's names tell the
    functions of one maker apart within a process only.
    """
    function.__qualname__ += "".join(f"_{value}" for value in values_of_closure(function))


@contextlib.contextmanager
def _uncollected() -> Iterator[None]:
    """Put off the search for garbage in cycles, where there is memory: a tenth of the time of numba.

    What is put off is some 80 MiB.
    """
    on = gc.isenabled()
    if TIGHT_MEMORY not in os.environ:
        gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def types_of(arguments: tuple[Any, ...]) -> list[Any]:
    """Return numba's types of examples; what is a type already stays."""
    return [each if isinstance(each, numba.types.Type) else numba.typeof(each) for each in arguments]


def _borrowed(kind: Any) -> bool:
    """Return whether values of a type hold no array."""
    if isinstance(kind, numba.types.BaseTuple):
        return all(_borrowed(each) for each in kind.types)
    return not isinstance(kind, numba.types.Array)


class _CallbackCache(KernelCache):
    """The compiled variants of a function that is called by its address."""

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep what was compiled; it must have an address by then."""
        result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)
        super().save_overload(signature, result)


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """A kernel as Python sees it; kernels that call it see ``callee``."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._cache = KernelCache(function)
        self.callee = _Callee(
            function, targetoptions={**options, "no_cpython_wrapper": True}, pipeline_class=_CalleeCompiler
        )

    def compile(self, sig: Any) -> Any:
        """Compile for the types of arguments."""
        with _uncollected():
            return super().compile(sig)

    @property
    def _numba_type_(self) -> Any:
        return _CalleeType(self.callee)


class _CalleeType(numba.types.Dispatcher):  # type: ignore[misc]
    """A kernel in another one: called by name, so that it needs no address.

    numba would put the address of its object in, which is valid in one process only: such code is not cached.
    """


register_default(_CalleeType)(OpaqueModel)


@lower_constant(_CalleeType)  # type: ignore[untyped-decorator]
def _no_address(context: Any, builder: Any, kind: Any, kernel: Any) -> Any:
    return context.get_dummy_value()


class _Callee(CPUDispatcher):  # type: ignore[misc]
    """A kernel as other kernels see it."""

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the signature of a call; numba's own way is to compile anew for each constant."""
        return super().get_call_template([numba.types.unliteral(each) for each in args], kws)


class _CalleeLibrary(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel for the kernels that call it: linked into theirs, never run by itself."""

    def _optimize_final_module(self) -> None:
        """Do nothing: the code is optimised in the caller's library."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalleeLowering(NativeLowering):  # type: ignore[misc]
    """Translate to LLVM's language, and no further."""

    _name = "callee_lowering"

    def run_pass(self, state: Any) -> bool:
        """See :class:`NativeLowering`."""
        name = state.func_id.func_qualname
        if not state.flags.nrt and not _borrowed(state.return_type):
            raise TypeError(f"{name} returns an array: it cannot borrow all of them")
        state.library = _CalleeLibrary(state.targetctx.codegen(), name)
        state.library.enable_object_caching()
        state.flags.no_compile = True
        super().run_pass(state)
        done = state["cr"]
        # numba knows what can be called by a function of Python; this one would not work, and nobody has it
        entry = _dynfunc.make_function(
            done.fndesc.lookup_module(), name.split(".")[-1], "", 0, done.env, (state.library,)
        )
        state.targetctx.insert_user_function(entry, done.fndesc, [state.library])
        state["cr"] = _LowerResult(done.fndesc, done.call_helper, cfunc=entry, env=done.env)
        return True


class _CalleeCompiler(Compiler):  # type: ignore[misc]
    """numba's compiler with the last step left out."""

    def define_pipelines(self) -> list[Any]:
        """Return the passes."""
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.add_pass_after(_CalleeLowering, NativeLowering)
        manager.passes = [each for each in manager.passes if each[0] is not NativeLowering]
        manager.finalize()
        return [manager]
