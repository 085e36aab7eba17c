"""Public recordings of real benches, each with the model that a diagnosis starts from: one file a data set."""

from __future__ import annotations

from importlib import import_module

from torchrl_athletic.recordings.datasets.dataset import Dataset

DATASETS = ("emps", "two_link_arm", "unbalanced_disk", "pendulum", "xl330")


def load_dataset(name: str) -> Dataset:
    """Recordings and start model of one of :data:`DATASETS`.

    Raises:
        ValueError: If there is no data set of that name.
        FetchError: If its files are neither in $ATHLETIC_DATA nor to be downloaded.

    Example:
        >>> dataset = load_dataset("emps")  # doctest: +SKIP
        >>> dataset.heldout[0].metadata["excitation"]  # doctest: +SKIP
        'position profile with force pulses, closed loop'
    """
    if name not in DATASETS:
        raise ValueError(f"there is no data set {name!r}. Known are {', '.join(DATASETS)}.")
    dataset: Dataset = import_module(f"{__name__}.{name}").load()
    return dataset


__all__ = ["DATASETS", "Dataset", "load_dataset"]
