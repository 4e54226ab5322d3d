"""Sixteen lanes of float64 at a time: the inner steps of the searches, as vector instructions.

Of loops like these a compiler makes vectors or not, and of their answers, which branches wait for,
long chains of instructions; so they are spelled out in LLVM's language, which any processor can
run: a factor of 1.5 in a search.  Everything is rounded as written, nothing is contracted, so that
the distance of a box is never more than that of a point in it.

A leaf is a block of three rows: x, y and z of its sixteen points, empty lanes infinite; a node
six: the least and the greatest coordinates of its children's boxes.  A mask has bit l for lane l.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_tools: Any = cgutils

_ROW = 16
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_DOUBLES, _INTS = ir.VectorType(ir.DoubleType(), _ROW), ir.VectorType(_I32, _ROW)
_F8, _I8 = types.float64, types.int64


def _lowest_bit(_: Any, mask: Any) -> Any:
    def codegen(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return _I8(mask), codegen


def _distances_of(
    _: Any, points: Any, leaf: Any, x: Any, y: Any, z: Any, most2: Any, rows: Any, row: Any
) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        d2 = _from_points(builder, data, *arguments[1:5])
        out = data_of(context, builder, signature, arguments, 6)
        builder.store(d2, _pointer(builder, out, arguments[7], 1, 0), align=8)
        return builder.ctpop(_mask(builder, d2, arguments[5]))

    return _I8(points, _I8, _F8, _F8, _F8, _F8, rows, _I8), codegen


def _count_row(_: Any, rows: Any, row: Any, most: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = _load(builder, data_of(context, builder, signature, arguments, 0), arguments[1])
        return builder.ctpop(_mask(builder, values, arguments[2]))

    return _I8(rows, _I8, _F8), codegen


def _least_above(_: Any, rows: Any, n_rows: Any, floor: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        floors, nothing = splat(builder, arguments[2]), ir.Constant(_DOUBLES, [math.inf] * _ROW)
        least = _tools.alloca_once_value(builder, nothing)
        with _tools.for_range(builder, arguments[1]) as loop:
            values, best = _load(builder, data, loop.index), builder.load(least)
            is_above = builder.fcmp_ordered(">", values, floors)
            above = builder.select(is_above, values, nothing)
            is_less = builder.fcmp_ordered("<", above, best)
            builder.store(builder.select(is_less, above, best), least)
        kind = ir.FunctionType(ir.DoubleType(), [_DOUBLES])
        name = "llvm.vector.reduce.fmin.v16f64"
        reduce = _tools.get_or_insert_function(builder.module, kind, name)
        return builder.call(reduce, [builder.load(least)], fastmath=("nnan", "nsz"))

    return _F8(rows, _I8, _F8), codegen


def _lanes_of(_: Any, rows: Any, row: Any, value: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        values = _load(builder, data_of(context, builder, signature, arguments, 0), arguments[1])
        same = builder.fcmp_ordered("==", values, splat(builder, arguments[2]))
        return builder.zext(builder.bitcast(same, ir.IntType(_ROW)), _I64)

    return _I8(rows, _I8, _F8), codegen


def _boxes_near_box(
    _: Any,
    boxes: Any,
    node: Any,
    x0: Any,
    y0: Any,
    z0: Any,
    x1: Any,
    y1: Any,
    z1: Any,
    far2: Any,
) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        d2 = _from_boxes(builder, data, arguments[1], arguments[2:5], arguments[5:8])
        return _mask(builder, d2, arguments[8])

    return _I8(boxes, _I8, _F8, _F8, _F8, _F8, _F8, _F8, _F8), codegen


def _boxes_near(_: Any, boxes: Any, node: Any, x: Any, y: Any, z: Any, far2: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = data_of(context, builder, signature, arguments, 0)
        d2 = _from_boxes(builder, data, arguments[1], arguments[2:5], arguments[2:5])
        return _mask(builder, d2, arguments[5])

    return _I8(boxes, _I8, _F8, _F8, _F8, _F8), codegen


def data_of(context: Any, builder: Any, signature: Any, arguments: Any, i: int) -> Any:
    """Return the pointer to the elements of an array argument."""
    return context.make_array(signature.args[i])(context, builder, arguments[i]).data


def _pointer(builder: Any, data: Any, block: Any, n_rows: int, row: int) -> Any:
    """Return the pointer to a row of a block of ``n_rows``."""
    start = builder.mul(block, ir.Constant(_I64, n_rows * _ROW))
    place = builder.gep(data, [builder.add(start, ir.Constant(_I64, _ROW * row))])
    return builder.bitcast(place, _DOUBLES.as_pointer())


def _load(builder: Any, data: Any, block: Any, n_rows: int = 1, row: int = 0) -> Any:
    """Return a row of a block of ``n_rows``."""
    return builder.load(_pointer(builder, data, block, n_rows, row), align=8)


def splat(builder: Any, value: Any, vector: Any = _DOUBLES) -> Any:
    """Return a vector whose lanes all have one value."""
    nothing = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(nothing, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, nothing, ir.Constant(_INTS, [0] * _ROW))


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _squares(builder: Any, dx: Any, dy: Any, dz: Any) -> Any:
    """Return ``dx dx + dy dy + dz dz``."""
    xy = builder.fadd(builder.fmul(dx, dx), builder.fmul(dy, dy))
    return builder.fadd(xy, builder.fmul(dz, dz))


def _from_points(builder: Any, points: Any, leaf: Any, *query: Any) -> Any:
    """Return the squared distances of a leaf's points from the query."""
    steps = [
        builder.fsub(_load(builder, points, leaf, 3, a), splat(builder, query[a]))
        for a in range(3)
    ]
    return _squares(builder, *steps)


def _from_boxes(builder: Any, boxes: Any, node: Any, low: Any, high: Any) -> Any:
    """Return the squared distances of a node's boxes from the box between ``low`` and ``high``."""
    steps = []
    for a in range(3):
        after = builder.fsub(_load(builder, boxes, node, 6, a), splat(builder, high[a]))
        before = builder.fsub(splat(builder, low[a]), _load(builder, boxes, node, 6, 3 + a))
        nothing = ir.Constant(_DOUBLES, [0.0] * _ROW)
        steps.append(_larger(builder, _larger(builder, after, before), nothing))
    return _squares(builder, *steps)


def _mask(builder: Any, values: Any, most: Any) -> Any:
    """Return the mask of the lanes that are at most ``most``."""
    inside = builder.fcmp_ordered("<=", values, splat(builder, most))
    return builder.zext(builder.bitcast(inside, ir.IntType(_ROW)), _I64)


# lowest_bit(mask): the number of the lowest bit that is set
lowest_bit: Any = intrinsic(_lowest_bit)
# distances_of(points, leaf, x, y, z, most2, rows, row): fill a row with the points' squared
# distances, rounded alike; return how many are at most most2
distances_of: Any = intrinsic(_distances_of)
# count_row(rows, row, most): how many values of a row are at most ``most``
count_row: Any = intrinsic(_count_row)
# least_above(rows, n_rows, floor): the least value of n_rows rows that is above floor, not NaN
least_above: Any = intrinsic(_least_above)
# lanes_of(rows, row, value): a mask of the lanes of a row that hold the value
lanes_of: Any = intrinsic(_lanes_of)
# boxes_near(boxes, node, x, y, z, far2): a mask of the boxes at most far2 from a point, squared
boxes_near: Any = intrinsic(_boxes_near)
# boxes_near_box(boxes, node, x0, y0, z0, x1, y1, z1, far2): of those from a box
boxes_near_box: Any = intrinsic(_boxes_near_box)
