"""Networks that come with the library: numbers and text in one file each, checked before they are used."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchrl.modules import ValueOperator

from torchrl_athletic.networks.actor_critic import Trunk, actor, critic
from torchrl_athletic.networks.actuator_net import Sizes, sizes_of
from torchrl_athletic.networks.normalizer import RunningNormalizer

FORMAT = "torchrl_athletic/network/1"


def pretrained(name: str, *, trainable: bool = False) -> nn.Module:
    """A network that comes with the library, ready to act, or to go on learning.

    Args:
        name: ``"wbc"``, the whole-body controller of a B2 with a Z1, a policy that reads ``observation``;
            ``"wbc_critic"``, its value function; ``"uan"``, the actuator net of the arm that both were trained with.
            ``"wbc_wide"`` and ``"wbc_wide_critic"`` take the hand to the ground and behind the head, less exactly.
            ``"throw"``, ``"snatch"`` and ``"sled"`` are policies tuned to these tasks, ``"throw_critic"`` and
            ``"sled_critic"`` the value functions that two of them go on with.

        trainable: Whether it shall learn; else its parameters take no gradients.

    Returns:
        On the CPU. :func:`describe` tells what it is and how good it is.

    Raises:
        ValueError: If there is no such network, or its file is not the one that was shipped.

    Example:
        >>> sum(parameter.numel() for parameter in pretrained("uan").parameters())
        21889
    """
    return read_network(shipped_path(name), _index()[name]["sha256"], trainable=trainable)


def describe(name: str) -> dict[str, Any]:
    """What is known of a shipped network: its sizes, how it was trained, how it was evaluated.

    Example:
        >>> describe("uan")["kind"]
        'uan'
    """
    return read_metadata(shipped_path(name))


def write_network(path: str | Path, network: nn.Module, *, half: bool = False, **told: Any) -> str:
    """Write a policy, a value function or an actuator net so that :func:`read_network` can build it again.

    Args:
        path: File to write, ``.npz``; its folder is made.
        network: Of :func:`actor`, :func:`critic` or :func:`uan`.
        half: Whether weights take 16 bits: half the file, and each within 0.05 % of what it was, or within 3e-8.
        told: What else a reader should know, in what JSON can hold.

    Returns:
        The file's SHA-256.

    Raises:
        ValueError: If JSON cannot hold what was told, or 16 bits a weight.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "value.npz"
        >>> digest = write_network(path, critic(3, hidden=(4,)), seed=0)
        >>> read_metadata(path)["seed"], read_network(path, digest).in_keys
        (0, ['observation'])
    """
    path = Path(path)
    state = network.state_dict()
    arrays: dict[str, Any] = {
        name: value.detach().cpu().numpy() for name, value in state.items() if isinstance(value, Tensor)
    }
    extra = {name: value for name, value in state.items() if name not in arrays}
    if half:
        arrays |= {name: _halved(path, name, value) for name, value in arrays.items() if value.ndim == 2}
    metadata = {"format": FORMAT, **_kind_and_sizes(network), "extra": extra, **told}
    content = io.BytesIO()
    arrays["metadata"] = np.frombuffer(_json(path, metadata).encode(), np.uint8)
    np.savez(content, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_bytes(content.getvalue())
    os.replace(part, path)
    return hashlib.sha256(content.getvalue()).hexdigest()


def read_network(path: str | Path, sha256: str | None = None, *, trainable: bool = False) -> nn.Module:
    """Build a network from a file. Nothing in it is run.

    Args:
        path: Of :func:`write_network`.
        sha256: That the file must have; None takes any.
        trainable: As of :func:`pretrained`.

    Raises:
        ValueError: If it is another file, or holds something else than a network of this library.
    """
    path = Path(path)
    content = path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if sha256 is not None and found != sha256:
        raise ValueError(
            f"{path.name} has SHA-256 {found}, expected is {sha256}: it is damaged or was replaced. Install the "
            "library again, or read a network of your own without a digest."
        )
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        metadata = _metadata(path, arrays)
        state: dict[str, Any] = {name: torch.from_numpy(arrays[name]) for name in arrays.files if name != "metadata"}
    network = _build(path, metadata)
    network.load_state_dict(state | metadata["extra"])
    return network.train(trainable).requires_grad_(trainable)


def read_metadata(path: str | Path) -> dict[str, Any]:
    """What :func:`write_network` was told of a network.

    Raises:
        ValueError: If the file is of another format.
    """
    path = Path(path)
    with np.load(path, allow_pickle=False) as arrays:
        return _metadata(path, arrays)


def digest_of(network: nn.Module) -> str:
    """Names a network by its numbers alone, whatever file it came from.

    Example:
        >>> digest_of(pretrained("wbc")) == digest_of(pretrained("wbc")) != digest_of(pretrained("uan"))
        True
    """
    total = hashlib.sha256()
    for name, value in sorted(network.state_dict().items()):
        total.update(name.encode())
        total.update(value.cpu().float().numpy().tobytes() if isinstance(value, Tensor) else repr(value).encode())
    return total.hexdigest()[:16]


def _metadata(path: Path, arrays: Any) -> dict[str, Any]:
    metadata = json.loads(arrays["metadata"].tobytes()) if "metadata" in arrays.files else {}
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path.name} is not a network of format {FORMAT}. Write it with write_network.")
    return dict(metadata)


def _halved(path: Path, name: str, value: NDArray[np.floating]) -> NDArray[np.float16]:
    greatest, limit = float(np.abs(value).max(initial=0.0)), float(np.finfo(np.float16).max)
    if not greatest <= limit:
        raise ValueError(
            f"{path.name}: {name} has a weight of {greatest:g}, and 16 bits hold {limit:g} at most. Write it with "
            "half=False."
        )
    return value.astype(np.float16)


def _json(path: Path, metadata: Mapping[str, Any]) -> str:
    try:
        return json.dumps(metadata, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{path.name} cannot hold what was told of the network: {error}. Give what JSON has: text, finite numbers, "
            "lists and dictionaries of them."
        ) from None


def _kind_and_sizes(network: Any) -> dict[str, Any]:
    """What it takes to build a network of the same shape."""
    trunk = next((module for module in network.modules() if isinstance(module, Trunk)), None)
    if trunk is None:
        return {"kind": "uan", "sizes": asdict(sizes_of(network))}
    layers = [layer for layer in trunk.mlp.modules() if isinstance(layer, nn.Linear)]
    sizes: dict[str, Any] = {"in_features": layers[0].in_features, "in_keys": list(network.in_keys)}
    sizes |= {"hidden": [layer.out_features for layer in layers[:-1]]}
    normalized = isinstance(trunk.normalizer, RunningNormalizer)
    if isinstance(network, ValueOperator):
        return {"kind": "critic", "sizes": sizes, "normalized": normalized}
    return {"kind": "actor", "sizes": sizes | {"action_size": layers[-1].out_features}, "normalized": normalized}


def _build(path: Path, metadata: Mapping[str, Any]) -> nn.Module:
    kind, sizes = metadata["kind"], dict(metadata["sizes"])
    if kind == "uan":
        told: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in sizes.items()}
        return Sizes(**told).net()
    if kind not in ("actor", "critic"):
        raise ValueError(f"{path.name} holds a network of kind {kind!r}; known are actor, critic and uan.")
    normalizer = RunningNormalizer(sizes["in_features"]) if metadata["normalized"] else None
    return actor(**sizes, normalizer=normalizer) if kind == "actor" else critic(**sizes, normalizer=normalizer)


def _index() -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = json.loads((_folder() / "index.json").read_text("utf-8"))
    return found


def shipped_path(name: str) -> Path:
    """File of a network that comes with the library.

    Raises:
        ValueError: If there is no such network.
    """
    if name not in _index():
        raise ValueError(f"no network {name!r} comes with the library; it has {sorted(_index())}. Name one of these.")
    return _folder() / str(_index()[name]["file"])


def _folder() -> Path:
    return Path(str(resources.files("torchrl_athletic.networks") / "shipped"))
