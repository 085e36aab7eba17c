import pytest

from torchrl_athletic.transforms.keys import beside


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("push", "push_on"),
        (("robot", "push"), ("robot", "push_on")),
        (("world", "robot", "push"), ("world", "robot", "push_on")),
    ],
)
def test_what_belongs_to_an_entry_stands_in_the_same_group(key, expected):
    assert beside(key, "on") == expected
