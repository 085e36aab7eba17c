"""Units by hand, and every contradiction refused."""

import json
import math

import numpy as np
import pytest

from torchrl_athletic.recordings import Column, ColumnMap, RecordingError


@pytest.mark.parametrize(
    ("column", "field", "raw", "si"),
    [
        (Column("q"), "position", 1.5, 1.5),
        (Column("q", unit="deg"), "position", 180.0, math.pi),
        (Column("q", unit="rev"), "position_target", 0.5, math.pi),
        (Column("q", unit="mm"), "position", 246.0, 0.246),
        (Column("q", unit="counts", counts_per_revolution=4096), "position", 1024.0, math.pi / 2),
        (Column("q", unit="counts", counts_per_revolution=4096, zero=2048, scale=-1), "position", 3072.0, -math.pi / 2),
        (Column("q", unit="deg", scale=1 / 6), "position", 360.0, math.pi / 3),  # encoder before a 6:1 gear
        (Column("v", unit="rpm"), "velocity", 60.0, math.tau),
        (Column("v", unit="deg/s"), "velocity", 90.0, math.pi / 2),
        (Column("v", unit="counts/s", counts_per_revolution=100), "velocity", 100.0, math.tau),
        (Column("u", unit="mN·m"), "torque_command", 250.0, 0.25),
        (Column("u", unit="mNm"), "torque_command", 250.0, 0.25),
        (Column("u", unit="A", torque_constant=0.091), "torque_measured", 2.0, 0.182),
        (Column("u", unit="mA", torque_constant=0.5, zero=1000), "torque_measured", 3000.0, 1.0),
        (Column("u", unit="V", torque_constant=35.15065), "torque_command", 2.0, 70.3013),
        (Column("t", unit="ms"), "time", 1500.0, 1.5),
        (Column("t", unit="us"), "time", 3.0, 3e-6),
        (Column("t", unit="ns"), "time", 10_000_000.0, 0.01),
    ],
)
def test_units(column, field, raw, si):
    assert column.to_si(np.array([raw]), field, "log")[0] == pytest.approx(si, rel=1e-15)


def test_each_joint_may_have_its_own_encoder():
    column = Column("enc", unit="counts", counts_per_revolution=(4000, 2000), scale=(1, -1), zero=(0, 500))
    np.testing.assert_allclose(
        column.to_si(np.array([[1000.0, 1000.0]]), "position", "log"), [[math.pi / 2, -math.pi / 2]], rtol=1e-15
    )


def test_each_joint_may_have_its_own_unit():
    column = Column("q", unit=("deg", "mm", "counts"), counts_per_revolution=(None, None, 360))
    raw = np.array([[90.0, 90.0, 90.0]])
    np.testing.assert_allclose(column.to_si(raw, "position", "log"), [[math.pi / 2, 0.09, math.pi / 2]], rtol=1e-15)


@pytest.mark.parametrize(
    ("column", "advice"),
    [
        (Column("q", unit="furlong"), r"log: unit 'furlong' of column 'q' is not one of position. Known are rad"),
        (Column("q", unit="ms"), "unit 'ms' .* not one of position"),
        (Column("q", unit="counts"), "in counts, which needs counts_per_revolution"),
        (Column("q", unit="deg", counts_per_revolution=10), "has a counts_per_revolution, but its unit is 'deg'"),
        (Column("q", scale=(1, 2, 3)), "3 values of scale for 2 joints"),
    ],
)
def test_a_unit_that_cannot_be_applied_says_why(column, advice):
    with pytest.raises(RecordingError, match=advice):
        column.to_si(np.zeros((4, 2)), "position", "log")


@pytest.mark.parametrize(
    ("keywords", "advice"),
    [
        ({"name": ""}, "name in the file"),
        ({"name": 3}, "name in the file"),
        ({"name": "q", "scale": 0}, "not 0, which would wipe the signal out"),
        ({"name": "q", "scale": "2"}, "finite number"),
        ({"name": "q", "zero": math.nan}, "finite number"),
        ({"name": "q", "scale": 10**400}, "finite number"),
        ({"name": "q", "unit": {}}, "give a text, such as 'deg'"),
        ({"name": "q", "scale": True}, "finite number"),
        ({"name": "q", "scale": (1, None)}, "finite number"),
    ],
)
def test_a_malformed_column_is_refused(keywords, advice):
    with pytest.raises(RecordingError, match=advice):
        Column(**keywords)


@pytest.mark.parametrize(
    ("keywords", "advice"),
    [
        ({"joint_names": "hip"}, "list of different names"),
        ({"joint_names": ("a", "a")}, "list of different names"),
        ({"joint_names": ()}, "joint_names is empty"),
        ({"file_joint_names": ("1",)}, "must match joint_names"),
        ({"joint_names": ("a", "b"), "file_joint_names": ("1",)}, "must match joint_names"),
        ({"torque_command": "u", "position_target": "q"}, "name the one the robot followed"),
        ({"time": "t", "rate": 100.0}, "time and rate are both given"),
        ({"rate": 0}, "above 0"),
        ({"rate": "fast"}, "above 0"),
        ({"position": 3}, "position is 3"),
        ({"kp": (1.0, None)}, "one number, or one a joint"),
        ({"kp": "stiff"}, "one number, or one a joint"),
        ({"ignore": ("position",)}, "what can be left out"),
        ({"ignore": ("velocity",), "velocity": "v"}, "both given and ignored"),
        ({"state_topic": 5}, "give a text"),
        ({"metadata": "none"}, "names with their values"),
    ],
)
def test_a_contradictory_map_is_refused(keywords, advice):
    with pytest.raises(RecordingError, match=advice):
        ColumnMap(**keywords)


def test_a_map_in_json_is_the_map_in_python(tmp_path):
    path = tmp_path / "map.json"
    path.write_text(
        json.dumps(
            {
                "joint_names": ["hip", "knee"],
                "time": {"name": "t", "unit": "ms"},
                "position": {"name": "enc_{joint}", "unit": "counts", "counts_per_revolution": 4096, "scale": [1, -1]},
                "position_target": "target_{joint}",
                "kp": [30, 20],
                "kd": 1.0,
                "metadata": {"robot": "leg"},
            }
        )
    )
    assert ColumnMap.load(path) == ColumnMap(
        joint_names=("hip", "knee"),
        time=Column("t", unit="ms"),
        position=Column("enc_{joint}", unit="counts", counts_per_revolution=4096, scale=(1, -1)),
        position_target=Column("target_{joint}"),
        kp=(30, 20),
        kd=1.0,
        metadata={"robot": "leg"},
    )


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("{", "not a column map in JSON"),
        ("[]", "a column map is a JSON object, like"),
        ('{"postion": "q"}', "unknown key 'postion' in the column map; known are joint_names"),
        ('{"position": {"name": "q", "units": "deg"}}', "unknown key 'units' in position in the column map"),
        ('{"position": {"unit": "deg"}}', "position in the column map has no name"),
        ('{"kp": ["1"]}', "one number, or one a joint"),
        ('{"joint_names": 3}', "list of different names"),
        ('{"rate": true}', "above 0"),
    ],
)
def test_a_malformed_json_map_says_where(text, advice, tmp_path):
    (tmp_path / "map.json").write_text(text)
    with pytest.raises(RecordingError, match=advice) as caught:
        ColumnMap.load(tmp_path / "map.json")
    assert str(caught.value).startswith(str(tmp_path / "map.json"))


def test_the_map_that_messages_show_is_one(tmp_path):
    with pytest.raises(RecordingError, match=r"map\.json: there is no such column map\. Write one like \{") as caught:
        ColumnMap.load(tmp_path / "map.json")
    (tmp_path / "map.json").write_text(str(caught.value).partition("like ")[2])
    shown = ColumnMap.load(tmp_path / "map.json")
    assert [column.name for column in (shown.time, shown.position, shown.torque_command)] == [
        "t",
        "q_{joint}",
        "tau_{joint}",
    ]
