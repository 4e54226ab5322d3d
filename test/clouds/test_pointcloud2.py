import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from cello3d_ros.clouds.pointcloud2 import read_fields, read_points
from cello3d_ros.errors import CloudError

NUMBERS = {"f4": 7, "f8": 8, "u2": 4, "u1": 2}


def message(points, layout, *, big=False, height=1, padding=0, extra=b""):
    """Build a PointCloud2-like message; layout: (name, type, offset) of each field, point_step."""
    *fields, step = layout
    order = ">" if big else "<"
    dtype = np.dtype(
        {
            "names": [name for name, _, _ in fields],
            "formats": [order + kind for _, kind, _ in fields],
            "offsets": [offset for _, _, offset in fields],
            "itemsize": step,
        }
    )
    records = np.zeros(len(points), dtype)
    for name in dtype.names:
        column = {"x": 0, "y": 1, "z": 2, "intensity": 3}[name]
        records[name] = points[:, column]
    width = len(points) // height
    rows = records.view(np.uint8).reshape(height, width * step)
    data = np.hstack([rows, np.full((height, padding), 0xAB, np.uint8)]).tobytes() + extra
    return SimpleNamespace(
        width=width,
        height=height,
        point_step=step,
        row_step=width * step + padding,
        is_bigendian=big,
        is_dense=True,
        data=data,
        fields=[
            SimpleNamespace(name=name, offset=offset, datatype=NUMBERS[kind], count=1)
            for name, kind, offset in fields
        ],
    )


PLAIN = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), 12]
DOUBLE = [("x", "f8", 0), ("y", "f8", 8), ("z", "f8", 16), 24]
SHUFFLED = [("intensity", "u2", 2), ("z", "f4", 20), ("x", "f8", 4), ("y", "f4", 12), 32]


@pytest.fixture
def points():
    values = np.random.default_rng(3).integers(-999, 999, (60, 4)) / 8.0  # exact in float32
    values[:, 3] = np.arange(60)
    return values


@pytest.mark.parametrize("layout", [PLAIN, DOUBLE, SHUFFLED], ids=["f4", "f8", "shuffled"])
@pytest.mark.parametrize("big", [False, True], ids=["little", "big"])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (6, 0), (6, 7)])
def test_every_layout_gives_the_same_points(points, layout, big, height, padding):
    found = read_points(message(points, layout, big=big, height=height, padding=padding))
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, points[:, :3])


def test_the_last_row_may_come_without_its_padding(points):
    cloud = message(points, PLAIN, height=6, padding=5)
    cloud.data = cloud.data[:-5]
    np.testing.assert_array_equal(read_points(cloud), points[:, :3])


def test_sizes_that_a_message_makes_up_cost_no_memory(points):
    cloud = message(points, PLAIN)
    cloud.row_step = 2**32 - 1
    tracemalloc.start()
    np.testing.assert_array_equal(read_points(cloud), points[:, :3])
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_rows_of_no_position_take_their_companions_along(points):
    points[[0, 7], 0] = np.nan
    points[8, 2] = -np.inf
    fields = read_fields(message(points, SHUFFLED), ("intensity", "x"))
    expected = np.delete(np.arange(60), [0, 7, 8])
    np.testing.assert_array_equal(fields["intensity"], expected)
    np.testing.assert_array_equal(fields["x"], points[expected, 0])


def test_the_points_are_not_a_view_of_the_message(points):
    cloud = message(points, DOUBLE)
    cloud.data = bytearray(cloud.data)
    found = read_points(cloud)
    cloud.data[:] = bytes(len(cloud.data))
    np.testing.assert_array_equal(found, points[:, :3])


def test_an_empty_cloud_has_no_points():
    assert read_points(message(np.zeros((0, 4)), PLAIN)).shape == (0, 3)


def test_trailing_bytes_are_ignored(points):
    assert len(read_points(message(points, PLAIN, extra=b"abc"))) == 60


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: setattr(m, "data", m.data[:-1]), "declares 720 bytes but holds 719"),
        (lambda m: m.fields.pop(1), "no field 'y'"),
        (lambda m: m.fields.clear(), "it has none"),
        (lambda m: setattr(m.fields[0], "datatype", 77), "unknown datatype 77"),
        (lambda m: setattr(m.fields[2], "datatype", 6), "expected a float"),
        (lambda m: setattr(m.fields[0], "offset", 9), "beyond point_step 12"),
        (lambda m: setattr(m, "point_step", 0), "beyond point_step 0"),
        (lambda m: setattr(m, "point_step", 2**32 - 1), "point_step 4294967295 is absurd"),
    ],
)
def test_a_message_that_contradicts_itself_is_refused(points, change, words):
    cloud = message(points, PLAIN)
    change(cloud)
    with pytest.raises(CloudError, match=words):
        read_points(cloud)


@pytest.mark.parametrize("row_step", [0, 12, 7777])
@pytest.mark.parametrize("height", [1, 6])
def test_a_wrong_row_step_says_nothing_where_the_data_are_complete(points, row_step, height):
    cloud = message(points, PLAIN, height=height)
    cloud.row_step = row_step
    np.testing.assert_array_equal(read_points(cloud), points[:, :3])


def test_a_wrong_row_step_is_refused_where_it_alone_would_tell_the_rows(points):
    cloud = message(points, PLAIN, height=6, padding=4)
    cloud.row_step = 12
    with pytest.raises(CloudError, match="row_step 12 is less than width"):
        read_points(cloud)


def test_a_cloud_of_one_row_does_not_lose_points_to_a_row_step_of_another(points):
    cloud = message(points, PLAIN, extra=b"\0" * 24)
    cloud.row_step = 24
    assert len(read_points(cloud)) == 60
