"""Sixteen lanes of float32 at a time: the inner step of ``candidates.py``, as vector instructions.

Compilers turn loops like these into vectors or not, as they please; here it is a factor of three,
so the instructions are spelled out in LLVM's language, which any processor can run.

A list is made of blocks of sixteen candidates, four rows each: x, y, z as float32 and the
candidates' numbers as int32, empty lanes being infinitely far.  Block 0 is empty: it stands for
those that a list does not have, so that each list is read as ``BLOCKS`` blocks without a branch.
A lane's key is the bit pattern of its squared distance, whose order as an integer is that of the
distances, with the lane's number in its six lowest bits: all keys differ, and the least key names
its lane.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_tools: Any = cgutils

BLOCKS = 4  # of a list, at most: 64 lanes, as many as six bits can number
_ROW = 16
_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_F32, _ROW), ir.VectorType(_I32, _ROW)
_MOST = 0x7FFFFFFF


def _prefetch(_: Any, lanes: Any, first: Any, n_blocks: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = _data(context, builder, signature, arguments, 0)
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, _I32, _I32, _I32])
        prefetch = _tools.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        to_read_soon = [ir.Constant(_I32, value) for value in (0, 3, 1)]
        for block in _blocks(builder, arguments[1], arguments[2]):
            for row in range(4):
                line = builder.bitcast(_row(builder, data, block, row), pointer)
                builder.call(prefetch, [line, *to_read_soon])
        return context.get_dummy_value()

    return types.void(lanes, types.int64, types.int64), codegen


def _nearest_lanes(
    _: Any,
    lanes: Any,
    first: Any,
    n_blocks: Any,
    x: Any,
    y: Any,
    z: Any,
    k: Any,
    slack: Any,
    keys: Any,
) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = _data(context, builder, signature, arguments, 0)
        out = _data(context, builder, signature, arguments, 8)
        query = [_splat(builder, value, _FLOATS) for value in arguments[3:6]]
        blocks = _blocks(builder, arguments[1], arguments[2])
        all_keys = [_keys(builder, data, block, query, g) for g, block in enumerate(blocks)]
        key = _tools.alloca_once_value(builder, ir.Constant(_I32, -1))
        with _tools.for_range(builder, arguments[6]) as loop:
            builder.store(_least_above(builder, all_keys, builder.load(key)), key)
            builder.store(builder.load(key), builder.gep(out, [loop.index]))
        key = builder.load(key)
        return _mask_between(builder, all_keys, key, _too_close(builder, key, arguments[7]))

    f4, i8 = types.float32, types.int64
    return types.int64(lanes, i8, i8, f4, f4, f4, i8, f4, keys), codegen


def _data(context: Any, builder: Any, signature: Any, arguments: Any, i: int) -> Any:
    """Return the pointer to the elements of an array argument."""
    return context.make_array(signature.args[i])(context, builder, arguments[i]).data


def _splat(builder: Any, value: Any, vector: Any) -> Any:
    """Return a vector whose lanes all have one value."""
    nothing = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, nothing, ir.Constant(_INTS, [0] * _ROW))


def _blocks(builder: Any, first: Any, n_blocks: Any) -> list[Any]:
    """Return the numbers of a list's blocks, 0 in place of those that it does not have."""
    numbers = [ir.Constant(_I64, g) for g in range(BLOCKS)]
    return [
        builder.select(
            builder.icmp_signed("<", g, n_blocks), builder.add(first, g), ir.Constant(_I64, 0)
        )
        for g in numbers
    ]


def _row(builder: Any, data: Any, block: Any, row: int) -> Any:
    """Return the pointer to one of the four rows of a block."""
    start = builder.mul(block, ir.Constant(_I64, 4 * _ROW))
    return builder.gep(data, [builder.add(start, ir.Constant(_I64, _ROW * row))])


def _keys(builder: Any, data: Any, block: Any, query: list[Any], g: int) -> Any:
    """Return the keys of the g-th block of a list."""
    d2 = None
    for row, value in enumerate(query):
        pointer = builder.bitcast(_row(builder, data, block, row), _FLOATS.as_pointer())
        d = builder.fsub(builder.load(pointer, align=4), value)
        d2 = builder.fmul(d, d) if d2 is None else builder.fadd(d2, builder.fmul(d, d))
    cleared = builder.and_(builder.bitcast(d2, _INTS), ir.Constant(_INTS, [-64] * _ROW))
    return builder.or_(cleared, ir.Constant(_INTS, [_ROW * g + i for i in range(_ROW)]))


def _least_above(builder: Any, all_keys: list[Any], key: Any) -> Any:
    """Return the least of all keys that are greater than ``key``."""
    floor, most = _splat(builder, key, _INTS), ir.Constant(_INTS, [_MOST] * _ROW)
    least = most
    for keys in all_keys:
        above = builder.select(builder.icmp_signed(">", keys, floor), keys, most)
        least = builder.select(builder.icmp_signed("<", above, least), above, least)
    kind = ir.FunctionType(_I32, [_INTS])
    reduce = _tools.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.smin.v16i32")
    return builder.call(reduce, [least])


def _too_close(builder: Any, key: Any, slack: Any) -> Any:
    """Return the greatest key that rounding may have put behind ``key``; see candidates.py."""
    d2 = builder.bitcast(builder.or_(key, ir.Constant(_I32, 63)), _F32)
    grown = builder.fmul(d2, ir.Constant(_F32, 1.0 + 2.0**-14))
    sane = builder.icmp_signed("<", key, ir.Constant(_I32, 0x7E000000))  # far from overflow
    bits = builder.bitcast(builder.fadd(grown, slack), _I32)
    return builder.select(sane, bits, ir.Constant(_I32, _MOST))


def _mask_between(builder: Any, all_keys: list[Any], above: Any, most: Any) -> Any:
    """Return the mask of the lanes whose keys are greater than ``above``, at most ``most``."""
    floor, top = _splat(builder, above, _INTS), _splat(builder, most, _INTS)
    mask = ir.Constant(_I64, 0)
    for g, keys in enumerate(all_keys):
        inside = builder.and_(
            builder.icmp_signed(">", keys, floor), builder.icmp_signed("<=", keys, top)
        )
        bits = builder.zext(builder.bitcast(inside, ir.IntType(_ROW)), _I64)
        mask = builder.or_(mask, builder.shl(bits, ir.Constant(_I64, _ROW * g)))
    return mask


# prefetch(lanes, first, n_blocks): fetch a list into the cache, without waiting for it
prefetch: Any = intrinsic(_prefetch)
# nearest_lanes(lanes, first, n_blocks, x, y, z, k, slack, keys): write the k least keys,
# ascending; return a mask of the lanes too close behind the k-th to tell in float32
nearest_lanes: Any = intrinsic(_nearest_lanes)


def _lane_keys(
    _: Any, lanes: Any, block: Any, x: Any, y: Any, z: Any, row: Any, keys: Any
) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = _data(context, builder, signature, arguments, 0)
        out = _data(context, builder, signature, arguments, 6)
        start = builder.mul(arguments[1], ir.Constant(_I64, 3 * _ROW))
        d2 = None
        for axis in range(3):
            pointer = builder.gep(data, [builder.add(start, ir.Constant(_I64, _ROW * axis))])
            pointer = builder.bitcast(pointer, _FLOATS.as_pointer())
            d = builder.fsub(
                builder.load(pointer, align=4), _splat(builder, arguments[2 + axis], _FLOATS)
            )
            d2 = builder.fmul(d, d) if d2 is None else builder.fadd(d2, builder.fmul(d, d))
        cleared = builder.and_(builder.bitcast(d2, _INTS), ir.Constant(_INTS, [-1024] * _ROW))
        slot = builder.trunc(builder.shl(arguments[5], ir.Constant(_I64, 4)), _I32)
        names = builder.or_(_splat(builder, slot, _INTS), ir.Constant(_INTS, list(range(_ROW))))
        value = builder.or_(cleared, names)
        first = builder.gep(out, [builder.mul(arguments[5], ir.Constant(_I64, _ROW))])
        builder.store(value, builder.bitcast(first, _INTS.as_pointer()), align=4)
        return context.get_dummy_value()

    f4, i8 = types.float32, types.int64
    return types.void(lanes, i8, f4, f4, f4, i8, keys), codegen


def _least_key_above(_: Any, keys: Any, n_rows: Any, key: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = _data(context, builder, signature, arguments, 0)
        floor, most = _splat(builder, arguments[2], _INTS), ir.Constant(_INTS, [_MOST] * _ROW)
        least = _tools.alloca_once_value(builder, most)
        builder.store(most, least)
        with _tools.for_range(builder, arguments[1]) as loop:
            first = builder.gep(data, [builder.mul(loop.index, ir.Constant(_I64, _ROW))])
            row = builder.load(builder.bitcast(first, _INTS.as_pointer()), align=4)
            above = builder.select(builder.icmp_signed(">", row, floor), row, most)
            before = builder.load(least)
            builder.store(
                builder.select(builder.icmp_signed("<", above, before), above, before), least
            )
        kind = ir.FunctionType(_I32, [_INTS])
        reduce = _tools.get_or_insert_function(
            builder.module, kind, "llvm.vector.reduce.smin.v16i32"
        )
        return builder.call(reduce, [builder.load(least)])

    return types.int32(keys, types.int64, types.int32), codegen


lane_keys: Any = intrinsic(_lane_keys)
least_above: Any = intrinsic(_least_key_above)
