"""Parts of kernels: planes (H, W) read and written so that LLVM takes many pixels at once, and their values.

They round as numpy and ``cv2.remap`` do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from v2hdm.compiled import exactly_inlined
from v2hdm.simulate.render.scene import TILE_PX

Plane = NDArray[np.float32]
_numba_arrays: Any = arrayobj  # which states no types
_numba_code: Any = cgutils
_f = np.float32
_i = np.int32

# Numbers in float32: an operand in float64 would widen what a kernel computes.
_TILE = _f(TILE_PX)  # side of a tile, px
ONE = _f(1.0)  # a whole pixel, and a tone that changes nothing
HALF = _f(0.5)  # half a pixel, from which on it counts as covered
ZERO = _f(0.0)  # none of a pixel
_NEXT = _i(1)  # from a row or column to the following one


def _rounded_once(_: Any, a: Any, b: Any, c: Any) -> Any:
    def build(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        factor, other, addend = arguments
        return builder.fma(factor, other, addend)

    return types.float32(types.float32, types.float32, types.float32), build


fma: Any = intrinsic(_rounded_once)  # a b + c rounded once, as in cv2.remap


def _place(context: Any, builder: Any, kind: Any, plane: Any, row: Any, column: Any) -> Any:
    """The address of a pixel of a plane (H, W); by numbers of 32 bits processors gather fastest.

    Of those of 64 bits LLVM sees which lie side by side.
    """
    array = _numba_arrays.make_array(kind)(context, builder, plane)
    width = _numba_code.unpack_tuple(builder, array.shape, 2)[1]
    if row.type.width == 64:
        return builder.gep(array.data, [builder.add(builder.mul(row, width), column)])
    width = builder.trunc(width, row.type)
    flat = builder.add(builder.mul(row, width, flags=["nsw"]), column, flags=["nsw"])
    return builder.gep(array.data, [builder.sext(flat, cgutils.intp_t)])


def _number(row: Any, column: Any) -> Any:
    """The type of numbers of rows and columns: 32 bits where both have them."""
    return types.int32 if row == column == types.int32 else types.int64


def _what_is_read(builder: Any) -> Any:
    """LLVM's name of all that :data:`read` reads."""
    module = builder.module
    domain = module.add_metadata(["v2hdm pixels"])
    return module.add_metadata([module.add_metadata(["v2hdm read", domain])])


def _reading(is_marked: bool) -> Any:
    def plan(_: Any, plane: Any, row: Any, column: Any) -> Any:
        if plane.layout != "C":
            return None  # numba then refuses the call

        def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            value = builder.load(_place(context, builder, signature.args[0], *arguments))
            value.set_metadata("alias.scope" if is_marked else "noalias", _what_is_read(builder))
            return value

        number = _number(row, column)
        return plane.dtype(plane, number, number), build

    return plan


def _marked_write(_: Any, plane: Any, row: Any, column: Any, value: Any) -> Any:
    if plane.layout != "C":
        return None

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        *place, number = arguments
        number = context.get_value_as_data(builder, signature.args[3], number)
        stored = builder.store(number, _place(context, builder, signature.args[0], *place))
        stored.set_metadata("noalias", _what_is_read(builder))
        return context.get_dummy_value()

    number = _number(row, column)
    return types.none(plane, number, number, plane.dtype), build


# Values of planes to which no ``write`` of their kernel writes. LLVM cannot know that of a texture, whose
# pixels it would otherwise take one by one: with it a kernel takes less than half of the time.
read: Any = intrinsic(_reading(is_marked=True))
read_back: Any = intrinsic(_reading(is_marked=False))  # of planes to which their kernel writes
write: Any = intrinsic(_marked_write)


@exactly_inlined
def clip(value: Any, low: Any, high: Any) -> Any:
    """A number within two others."""
    return min(max(value, low), high)


@exactly_inlined
def _wrap(metres: Any, per_metre: Any, turn: Any) -> Any:
    turns = metres * per_metre
    turns += turn
    turns -= _f(np.floor(turns))
    return turns * _TILE


@exactly_inlined
def sampled(tile: Plane, x_m: Any, y_m: Any, per_metre: Any, turn_x: Any, turn_y: Any) -> Any:
    """A padded tile's value at a ground point, as :func:`v2hdm.simulate.render.scene.sample` has it."""
    x = _wrap(x_m, per_metre, turn_x)
    y = _wrap(y_m, per_metre, turn_y)
    column = _i(x)
    row = _i(y)
    share_x = x - _f(column)
    share_y = y - _f(row)
    right = _i(column + _NEXT)
    under = _i(row + _NEXT)
    return between(tile, (row, under, column, right), share_x, share_y)


@exactly_inlined
def between(plane: Any, places: Any, share_x: Any, share_y: Any) -> Any:
    """The value between four pixels, in two rows and two columns, as ``cv2.remap`` has it."""
    top, bottom, left, right = places
    upper = read(plane, top, left)
    lower = read(plane, bottom, left)
    above = fma(share_x, read(plane, top, right) - upper, upper)
    below = fma(share_x, read(plane, bottom, right) - lower, lower)
    return fma(share_y, below - above, above)


@exactly_inlined
def fade(footprint_m: Any, per_wave: Any) -> Any:
    """A texture's amplitude where a pixel covers so much ground, by its finest waves a metre."""
    waves = footprint_m * per_wave
    return ONE / (ONE + waves * waves)
