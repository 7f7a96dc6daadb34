"""Eight numbers side by side: explicit vector arithmetic for the loops of the fit.

A sum over the columns of a table runs in eight lanes, each with a partial sum of its own, and every operation
says itself whether it rounds once or twice. So the compiler needs no leave to reorder or to contract, and the
bits do not depend on how, or how often, it optimises; the vector instructions are there all the same.

In compiled functions a value of `Simd` is an LLVM vector; in plain Python the same code runs on numpy arrays
of eight. Operators are ``+ - * /`` of lanes with lanes or numbers; the functions are below.

The compiler is taught the vector through parts of numba that may change. Where it cannot be taught, the same
loops run on one number at a time: ``SIMD_WIDTH`` is 1, sums are slower and other in the last bits.
"""

from __future__ import annotations

import functools
import math
import operator
import warnings
from collections.abc import Callable
from typing import Any, TypeAlias

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typeconv import Conversion
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, overload, register_model

from pchem_pipeline.base.arrays import FloatArray

Simd: TypeAlias = FloatArray
Value: TypeAlias = Simd | float

_WIDTH = 8  # doubles in the widest vector register
_DOUBLES = ir.VectorType(ir.DoubleType(), _WIDTH)
_WORDS = ir.VectorType(ir.IntType(64), _WIDTH)
_MANTISSA_BITS = 52
_EXPONENT_BIAS = 1023


class _SimdType(types.Type):
    """The compiler's type of `Simd`; a number becomes one with the same value in each lane."""

    def can_convert_from(self, _context: Any, other: Any) -> Any:
        """Allow numbers wherever lanes are expected."""
        return Conversion.safe if isinstance(other, types.Float | types.Integer) else None


_SIMD = _SimdType(name="Simd")


class _SimdModel(models.PrimitiveModel):  # type: ignore[misc]
    """A vector of the machine."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


def _constant(kind: Any, value: float) -> Any:
    return ir.Constant(kind, [ir.Constant(kind.element, value)] * _WIDTH)


def _splat(builder: Any, value: Any) -> Any:
    lane = ir.Constant(ir.IntType(32), 0)
    vector = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, lane)
    return builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(ir.IntType(32), _WIDTH), None))


def _from_number(context: Any, builder: Any, kind: Any, _target: Any, value: Any) -> Any:
    return _splat(builder, context.cast(builder, value, kind, types.float64))


def _operator(function: Any, name: str) -> None:
    """Teach the compiler an operator of two lanes."""
    cases = [signature(_SIMD, _SIMD, _SIMD)]
    infer_global(function)(type(f"_Lanes_{name}", (ConcreteTemplate,), {"cases": cases}))

    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return getattr(builder, name)(*arguments)

    lower_builtin(function, _SimdType, _SimdType)(emit)


def _teach_compiler() -> None:
    """Teach the compiler the type, its operators, and that a number may stand for lanes of that number."""
    register_model(_SimdType)(_SimdModel)
    for kind in (types.Float, types.Integer):
        lower_cast(kind, _SimdType)(_from_number)
    operators = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    for function, name in operators.items():
        _operator(function, name)


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    """Call an LLVM intrinsic of doubles on vectors."""
    kind = ir.FunctionType(_DOUBLES, [_DOUBLES] * len(arguments))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{_WIDTH}f64")
    return builder.call(function, arguments)


def _elementwise(name: str, arity: int) -> Callable[..., Any]:
    """Return a generator of code and its signature for an LLVM intrinsic of so many lanes."""
    kind = signature(_SIMD, *[_SIMD] * arity)

    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return _call(builder, name, *arguments)

    return lambda: (kind, emit)


def _chosen(comparison: str) -> Callable[..., Any]:
    """Return a generator of code and its signature for the one of two that a comparison favours."""

    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(comparison, *arguments), *arguments)

    return lambda: (signature(_SIMD, _SIMD, _SIMD), emit)


_FMA, _ROUND, _LEAST, _MOST = _elementwise("fma", 3), _elementwise("rint", 1), _chosen("<"), _chosen(">")


@intrinsic
def _fma(_typing: Any, _x: Any, _y: Any, _z: Any) -> Any:
    return _FMA()


@intrinsic
def _rint(_typing: Any, _x: Any) -> Any:
    return _ROUND()


@intrinsic
def _smaller(_typing: Any, _x: Any, _y: Any) -> Any:
    return _LEAST()


@intrinsic
def _larger(_typing: Any, _x: Any, _y: Any) -> Any:
    return _MOST()


@intrinsic
def _exponent_of(_typing: Any, _x: Any) -> Any:
    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        words = builder.bitcast(arguments[0], _WORDS)
        exponent = builder.lshr(words, _constant(_WORDS, _MANTISSA_BITS))
        return builder.sitofp(builder.sub(exponent, _constant(_WORDS, _EXPONENT_BIAS)), _DOUBLES)

    return signature(_SIMD, _SIMD), emit


@intrinsic
def _scaled(_typing: Any, _x: Any, _power: Any) -> Any:
    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        power = builder.shl(builder.fptosi(arguments[1], _WORDS), _constant(_WORDS, _MANTISSA_BITS))
        return builder.bitcast(builder.add(builder.bitcast(arguments[0], _WORDS), power), _DOUBLES)

    return signature(_SIMD, _SIMD, _SIMD), emit


@intrinsic
def _counting(_typing: Any) -> Any:
    def emit(_context: Any, _builder: Any, _signature: Any, _arguments: Any) -> Any:
        return ir.Constant(_DOUBLES, [ir.Constant(ir.DoubleType(), float(i)) for i in range(_WIDTH)])

    return signature(_SIMD), emit


@intrinsic
def _spliced(_typing: Any, _n: Any, _x: Any, _y: Any) -> Any:
    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        word = ir.IntType(32)
        kind = ir.VectorType(word, _WIDTH)
        lanes = ir.Constant(kind, [ir.Constant(word, i) for i in range(_WIDTH)])
        number = builder.trunc(arguments[0], word)
        filled = builder.insert_element(ir.Constant(kind, ir.Undefined), number, ir.Constant(word, 0))
        filled = builder.shuffle_vector(filled, filled, ir.Constant(kind, None))
        return builder.select(builder.icmp_signed("<", lanes, filled), arguments[1], arguments[2])

    return signature(_SIMD, types.intp, _SIMD, _SIMD), emit


def _place(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
    """Return the address of eight successive elements of a row."""
    kind = sig.args[0]
    array = context.make_array(kind)(context, builder, arguments[0])
    element = cgutils.get_item_pointer(context, builder, kind, array, list(arguments[1:3]))
    return builder.bitcast(element, _DOUBLES.as_pointer())


@intrinsic
def _load(_typing: Any, table: Any, _row: Any, _column: Any) -> Any:
    def emit(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.load(_place(context, builder, sig, arguments), align=8, typ=_DOUBLES)

    return signature(_SIMD, table, types.intp, types.intp), emit


@intrinsic
def _store(_typing: Any, table: Any, _row: Any, _column: Any, _x: Any) -> Any:
    def emit(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        builder.store(arguments[3], _place(context, builder, sig, arguments), align=8)
        return context.get_dummy_value()

    return signature(types.void, table, types.intp, types.intp, _SIMD), emit


def _part(builder: Any, vector: Any, first: int, size: int) -> Any:
    """Return successive elements of a vector as a shorter vector."""
    word = ir.IntType(32)
    places = ir.Constant(ir.VectorType(word, size), [ir.Constant(word, first + i) for i in range(size)])
    return builder.shuffle_vector(vector, vector, places)


@intrinsic
def _sum(_typing: Any, _x: Any) -> Any:
    def emit(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        part, size = arguments[0], _WIDTH
        while size > 1:
            size //= 2
            low, high = (_part(builder, part, first, size) for first in (0, size))
            part = builder.fadd(low, high)
        return builder.extract_element(part, ir.Constant(ir.IntType(32), 0))

    return signature(types.float64, _SIMD), emit


def fused(x: Value, y: Value, z: Value) -> Simd:
    """Return ``x y + z``, compiled: rounded once."""
    return np.asarray(x * y + z)


def nearest(x: Simd) -> Simd:
    """Return the nearest whole numbers."""
    return np.asarray(np.rint(x))


def least(x: Value, y: Value) -> Simd:
    """Return the smaller of each two."""
    return np.asarray(np.minimum(x, y))


def most(x: Value, y: Value) -> Simd:
    """Return the larger of each two."""
    return np.asarray(np.maximum(x, y))


def exponent_of(x: Simd) -> Simd:
    """Return floor(log2 x) of positive normal numbers."""
    return np.asarray(np.frexp(x)[1] - 1.0)


def scaled(x: Simd, power: Simd) -> Simd:
    """Return ``x 2^power`` for whole powers that leave it a normal number."""
    return np.asarray(np.ldexp(x, np.asarray(power).astype(int)))


def counting() -> Simd:
    """Return 0 ... 7."""
    return np.arange(float(SIMD_WIDTH))


def spliced(n: int, x: Value, y: Value) -> Simd:
    """Return x in the first n lanes, y in the others."""
    return np.where(np.arange(SIMD_WIDTH) < n, x, y)


def simd_load(table: FloatArray, row: int, column: int) -> Simd:
    """Return eight successive elements of a row of a table."""
    return table[row, column : column + SIMD_WIDTH].copy()


def simd_store(table: FloatArray, row: int, column: int, x: Value) -> None:
    """Write eight successive elements of a row of a table."""
    table[row, column : column + SIMD_WIDTH] = x


def simd_sum(x: Simd) -> float:
    """Return the sum, in a fixed order."""
    parts = list(x)
    while len(parts) > 1:
        half = len(parts) // 2
        parts = [parts[i] + parts[half + i] for i in range(half)]
    return float(parts[0])


_Choice: TypeAlias = Callable[..., Callable[..., Any]]  # of what is compiled, from the types of the arguments

_VECTOR: dict[Callable[..., Any], _Choice] = {
    fused: lambda x, y, z: lambda x, y, z: _fma(x, y, z),
    nearest: lambda x: lambda x: _rint(x),
    least: lambda x, y: lambda x, y: _smaller(x, y),
    most: lambda x, y: lambda x, y: _larger(x, y),
    exponent_of: lambda x: lambda x: _exponent_of(x),
    scaled: lambda x, power: lambda x, power: _scaled(x, power),
    counting: lambda: lambda: _counting(),
    spliced: lambda n, x, y: lambda n, x, y: _spliced(n, x, y),
    simd_load: lambda table, row, column: lambda table, row, column: _load(table, row, column),
    simd_store: lambda table, row, column, x: lambda table, row, column, x: _store(table, row, column, x),
    simd_sum: lambda x: lambda x: _sum(x),
}

_SCALAR: dict[Callable[..., Any], _Choice] = {
    fused: lambda x, y, z: lambda x, y, z: x * y + z,
    nearest: lambda x: lambda x: np.rint(x),
    least: lambda x, y: lambda x, y: min(float(x), float(y)),
    most: lambda x, y: lambda x, y: max(float(x), float(y)),
    exponent_of: lambda x: lambda x: math.frexp(x)[1] - 1.0,
    scaled: lambda x, power: lambda x, power: math.ldexp(x, int(power)),
    counting: lambda: lambda: 0.0,
    spliced: lambda n, x, y: lambda n, x, y: float(x) if n > 0 else float(y),
    simd_load: lambda table, row, column: lambda table, row, column: table[row, column],
    simd_store: lambda table, row, column, x: (
        lambda table, row, column, x: operator.setitem(table, (row, column), x)
    ),
    simd_sum: lambda x: lambda x: x,
}


def _named(function: Callable[..., Any], choose: _Choice) -> _Choice:
    """Return what chooses the implementation of a function, which bears its name: all lambdas have one."""

    @functools.wraps(choose)
    def chosen(*kinds: Any) -> Callable[..., Any]:
        implementation = choose(*kinds)
        implementation.__qualname__ = f"compiled_{function.__name__}"
        return implementation

    return chosen


def _simd_width() -> int:
    """Teach the compiler the functions above; return how many numbers lie side by side."""
    try:
        _teach_compiler()
        lanes, compiled = _WIDTH, _VECTOR
    except Exception as error:
        warnings.warn(
            f"numba {numba.__version__} without vector instructions ({error}): the fit is several times "
            "slower; install a version that pyproject.toml allows",
            stacklevel=2,
        )
        lanes, compiled = 1, _SCALAR
    for function, choose in compiled.items():
        overload(function)(_named(function, choose))
    return lanes


#: Numbers side by side: 8, or 1 where the compiler cannot be taught vectors.
SIMD_WIDTH = _simd_width()
