"""Sixteen lanes of float32 at a time: the inner steps of ICP's searches, as vector instructions.

Compilers turn loops like these into vectors or not, as they please; here it is a factor of three,
so the instructions are spelled out in LLVM's language, which any processor can run.

In ``candidates.py`` a list is made of blocks of sixteen candidates, four rows each: x, y, z as
float32 and the candidates' numbers as int32, empty lanes being infinitely far.  Block 0 is empty:
it stands for those that a list does not have, so that each list is read as ``BLOCKS`` blocks
without a branch.  In ``search.py`` a leaf is a block of three rows, and the keys of all leaves
that a query looks at are the rows of a table.

A lane's key is the bit pattern of its squared distance, whose order as an integer is that of the
distances, with a number in its lowest bits, so that all keys differ and the least key names its
lane: in a list the number of the lane, six bits; in a table that of row and lane, ten.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from cello3d_ros.clouds.lanes import data_of, splat

_tools: Any = cgutils

BLOCKS = 4  # of a list, at most: 64 lanes, as many as six bits can number
_ROW = 16
_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_FLOATS, _INTS = ir.VectorType(_F32, _ROW), ir.VectorType(_I32, _ROW)
_MOST = 0x7FFFFFFF


def _prefetch(_: Any, lanes: Any, first: Any, n_blocks: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
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
        data = data_of(context, builder, signature, arguments, 0)
        out = data_of(context, builder, signature, arguments, 8)
        query = [splat(builder, value, _FLOATS) for value in arguments[3:6]]
        blocks = _blocks(builder, arguments[1], arguments[2])
        all_keys = [
            _keys(builder, data, block, query, 4, 6, ir.Constant(_I32, _ROW * g))
            for g, block in enumerate(blocks)
        ]
        key = _tools.alloca_once_value(builder, ir.Constant(_I32, -1))
        with _tools.for_range(builder, arguments[6]) as loop:
            builder.store(_least_above(builder, all_keys, builder.load(key)), key)
            builder.store(builder.load(key), builder.gep(out, [loop.index]))
        key = builder.load(key)
        return _mask_between(builder, all_keys, key, _too_close(builder, key, arguments[7]))

    f4, i8 = types.float32, types.int64
    return types.int64(lanes, i8, i8, f4, f4, f4, i8, f4, keys), codegen


def _lane_keys(_: Any, lanes: Any, leaf: Any, x: Any, y: Any, z: Any, row: Any, keys: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        out = data_of(context, builder, signature, arguments, 6)
        query = [splat(builder, value, _FLOATS) for value in arguments[2:5]]
        first = builder.trunc(builder.mul(arguments[5], ir.Constant(_I64, _ROW)), _I32)
        values = _keys(builder, data, arguments[1], query, 3, 10, first)
        pointer = _row(builder, out, arguments[5], 0, 1)
        builder.store(values, builder.bitcast(pointer, _INTS.as_pointer()), align=4)
        return context.get_dummy_value()

    f4, i8 = types.float32, types.int64
    return types.void(lanes, i8, f4, f4, f4, i8, keys), codegen


def _least_key_above(_: Any, keys: Any, n_rows: Any, key: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        floor = splat(builder, arguments[2], _INTS)
        least = _tools.alloca_once(builder, _INTS)
        builder.store(ir.Constant(_INTS, [_MOST] * _ROW), least)
        with _tools.for_range(builder, arguments[1]) as loop:
            pointer = _row(builder, data, loop.index, 0, 1)
            values = builder.load(builder.bitcast(pointer, _INTS.as_pointer()), align=4)
            builder.store(_lesser_above(builder, values, floor, builder.load(least)), least)
        return _least_lane(builder, builder.load(least))

    return types.int32(keys, types.int64, types.int32), codegen


def _blocks(builder: Any, first: Any, n_blocks: Any) -> list[Any]:
    """Return the numbers of a list's blocks, 0 in place of those that it does not have."""
    numbers = [ir.Constant(_I64, g) for g in range(BLOCKS)]
    return [
        builder.select(
            builder.icmp_signed("<", g, n_blocks), builder.add(first, g), ir.Constant(_I64, 0)
        )
        for g in numbers
    ]


def _row(builder: Any, data: Any, block: Any, row: int, n_rows: int = 4) -> Any:
    """Return the pointer to one of the rows of a block."""
    start = builder.mul(block, ir.Constant(_I64, n_rows * _ROW))
    return builder.gep(data, [builder.add(start, ir.Constant(_I64, _ROW * row))])


def _keys(
    builder: Any, data: Any, block: Any, query: list[Any], n_rows: int, n_bits: int, first: Any
) -> Any:
    """Return the keys of a block, numbered from ``first`` on in their lowest ``n_bits``."""
    d2 = None
    for row, value in enumerate(query):
        pointer = _row(builder, data, block, row, n_rows)
        values = builder.load(builder.bitcast(pointer, _FLOATS.as_pointer()), align=4)
        d = builder.fsub(values, value)
        d2 = builder.fmul(d, d) if d2 is None else builder.fadd(d2, builder.fmul(d, d))
    cleared = builder.and_(builder.bitcast(d2, _INTS), ir.Constant(_INTS, [-1 << n_bits] * _ROW))
    lanes = ir.Constant(_INTS, list(range(_ROW)))
    return builder.or_(cleared, builder.or_(splat(builder, first, _INTS), lanes))


def _least_above(builder: Any, all_keys: list[Any], key: Any) -> Any:
    """Return the least of all keys that are greater than ``key``."""
    floor, least = splat(builder, key, _INTS), ir.Constant(_INTS, [_MOST] * _ROW)
    for keys in all_keys:
        least = _lesser_above(builder, keys, floor, least)
    return _least_lane(builder, least)


def _lesser_above(builder: Any, keys: Any, floor: Any, least: Any) -> Any:
    """Return in each lane the lesser of ``least`` and of the key, if that is above the floor."""
    above = builder.select(
        builder.icmp_signed(">", keys, floor), keys, ir.Constant(_INTS, [_MOST] * _ROW)
    )
    return builder.select(builder.icmp_signed("<", above, least), above, least)


def _least_lane(builder: Any, values: Any) -> Any:
    kind = ir.FunctionType(_I32, [_INTS])
    reduce = _tools.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.smin.v16i32")
    return builder.call(reduce, [values])


def _too_close(builder: Any, key: Any, slack: Any) -> Any:
    """Return the greatest key that rounding may have put behind ``key``; see candidates.py."""
    d2 = builder.bitcast(builder.or_(key, ir.Constant(_I32, 63)), _F32)
    grown = builder.fmul(d2, ir.Constant(_F32, 1.0 + 2.0**-14))
    sane = builder.icmp_signed("<", key, ir.Constant(_I32, 0x7E000000))  # far from overflow
    bits = builder.bitcast(builder.fadd(grown, slack), _I32)
    return builder.select(sane, bits, ir.Constant(_I32, _MOST))


def _mask_between(builder: Any, all_keys: list[Any], above: Any, most: Any) -> Any:
    """Return the mask of the lanes whose keys are greater than ``above``, at most ``most``."""
    floor, top = splat(builder, above, _INTS), splat(builder, most, _INTS)
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
# lane_keys(lanes, leaf, x, y, z, row, keys): fill a row of a table with the keys of a leaf
lane_keys: Any = intrinsic(_lane_keys)
# least_key_above(keys, n_rows, key): the least key of the first rows of a table that is above key
least_key_above: Any = intrinsic(_least_key_above)
