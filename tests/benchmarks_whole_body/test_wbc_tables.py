"""What is asked for is set beside what was measured."""

from benchmarks.wbc_tables import ALL, FINER, TARGETS, targets


def test_a_figure_on_its_bound_is_missed_and_one_under_it_met():
    bounds = {key: bound for key, (_, bound, _) in TARGETS.items()}
    results = {name: {key: [bound] for key, bound in bounds.items()} for name in (ALL, *FINER)}
    results[ALL]["attitude"] = [0.1499]
    lines = targets(results).splitlines()[2:]
    assert [line.split(" | ")[3] for line in lines] == ["missed", "missed", "met", "missed", "missed"]
    assert "| hand, attitude | 0.150 rad | under 0.150 rad | met | 0.150 rad | 0.150 rad |" in lines
