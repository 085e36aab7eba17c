"""Public recordings of real benches: from a folder of yours, or downloaded once at a pinned commit and checked."""

from __future__ import annotations

import gzip
import hashlib
import os
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from urllib.request import urlopen

from torchrl_athletic.recordings.whole_file import whole_file

RAW_FILES = "https://raw.githubusercontent.com"
"""Where public repositories serve their files as <repository>/<commit>/<path>."""
_TIMEOUT = 30.0


class FetchError(RuntimeError):
    """A data set that could not be had; the message says where to put its files by hand."""


@dataclass(frozen=True)
class RemoteFile:
    """One file at a pinned commit."""

    name: str
    """Path in the data set's folder. Where it ends in .gz and ``path`` does not, the file is compressed after the
    check."""
    path: str
    """Path in the repository."""
    commit: str
    """40 hex digits."""
    sha256: str
    """Checksum of the file as the repository has it."""


@dataclass(frozen=True)
class Source:
    """A data set as its authors published it."""

    repository: str
    """owner/name."""
    licence: str
    files: tuple[RemoteFile, ...]


def fetch(name: str, cache: str | Path | None = None, base_url: str = RAW_FILES) -> Path:
    """Folder with the files of one public data set.

    Looked for in ``$ATHLETIC_DATA/<name>``, then in the cache; only then downloaded into the cache, each file checked
    against its SHA-256 before it gets its name. Nothing is downloaded twice.

    Args:
        name: 'emps', 'two_link_arm', 'pendulum', 'xl330_bench' or 'unbalanced_disk'.
        cache: Folder for downloads. None: ``$XDG_CACHE_HOME/torchrl_athletic``, else ``~/.cache/torchrl_athletic``.
        base_url: Where the repositories' files are served, for mirrors.

    Raises:
        ValueError: If there is no such data set.
        FetchError: If a file cannot be downloaded, or is not the one that was pinned.

    Example:
        >>> folder = fetch("emps")  # doctest: +SKIP
        >>> (folder / "DATA_EMPS.mat").exists()  # doctest: +SKIP
        True
    """
    if name not in SOURCES:
        raise ValueError(f"there is no data set {name!r}. Known are {', '.join(SOURCES)}.")
    source = SOURCES[name]
    local = os.environ.get("ATHLETIC_DATA")
    if local and _complete(Path(local) / name, source):
        return Path(local) / name
    folder = (Path(cache) if cache is not None else _user_cache()) / name
    for file in source.files:
        if not (folder / file.name).exists():
            _download(name, source, file, folder, base_url)
    return folder


def _complete(folder: Path, source: Source) -> bool:
    return all((folder / file.name).exists() for file in source.files)


def _user_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchrl_athletic"


def _download(name: str, source: Source, file: RemoteFile, folder: Path, base_url: str) -> None:
    url = f"{base_url}/{source.repository}/{file.commit}/{file.path}"
    by_hand = (
        f"Put the file at {folder / file.name} by hand{' (compressed with gzip)' if _packed(file) else ''}, or set "
        f"ATHLETIC_DATA to a folder that holds {name}/ with all {len(source.files)} files."
    )
    try:
        with urlopen(url, timeout=_TIMEOUT) as response:
            content = response.read()
    except (OSError, HTTPException) as error:  # URLError is an OSError, a cut-off body is not
        raise FetchError(f"{name}: {url} cannot be downloaded ({error}). Is there a network? {by_hand}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != file.sha256:
        raise FetchError(
            f"{name}: {url} has SHA-256 {found}, pinned is {file.sha256}. The download was cut short or changed on "
            f"its way; nothing was stored. Try again. {by_hand}"
        )
    _write(folder / file.name, gzip.compress(content, mtime=0) if _packed(file) else content)


def _packed(file: RemoteFile) -> bool:
    return file.name.endswith(".gz") and not file.path.endswith(".gz")


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as part:
        part.write_bytes(content)


SOURCES: dict[str, Source] = {
    "emps": Source(
        "forgi86/sysid-neural-continuous",
        "Apache-2.0; the data is the public benchmark of nonlinearbenchmark.org",
        (
            RemoteFile(
                "DATA_EMPS.mat",
                "examples/EMPS/data/DATA_EMPS.mat",
                "93afc131780fb1d5477472935a18ac8405683890",
                "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
            ),
            RemoteFile(
                "DATA_EMPS_PULSES.mat",
                "examples/EMPS/data/DATA_EMPS_PULSES.mat",
                "93afc131780fb1d5477472935a18ac8405683890",
                "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704",
            ),
        ),
    ),
    "two_link_arm": Source(
        "dfki-ric-underactuated-lab/double_pendulum",
        "BSD-3-Clause",
        (
            RemoteFile(
                "20220812/20220812-055032-PM_measured.csv.gz",
                "data/experiment_records/design_A.0/20220812/sys_id/20220812-055032-PM_measured.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "30986e4eda0f559c30b0c009009e8943f3cac32cf5dcbcdc1c088ae638942b3a",
            ),
            RemoteFile(
                "20220812/20220812-055640-PM_measured.csv.gz",
                "data/experiment_records/design_A.0/20220812/sys_id/20220812-055640-PM_measured.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "59a9499806aedc30cc16e6b7b310c0c9c95f58fe4f003c1bcfe5e3192f441095",
            ),
            RemoteFile(
                "20220812/20220812-055903-PM_measured.csv.gz",
                "data/experiment_records/design_A.0/20220812/sys_id/20220812-055903-PM_measured.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "e31bcfe7f723ede46b654f496e9c2bbb26db7f0657e0e6a13ff75403786fe59e",
            ),
            RemoteFile(
                "20220815/noise/velocity_measurement/trajectory.csv.gz",
                "data/experiment_records/design_A.0/20220815/noise/velocity_measurement/trajectory.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "1fd387281583927b1661f599208d1b80a1e8ff9758fe0fb2d4fd8e3c43ac12d3",
            ),
            RemoteFile(
                "20220815/trajectory_00.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_00.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "3ea9f330443c902711faaf7f99059dd43e42ea30bb4e2d310d78aa1ec897532d",
            ),
            RemoteFile(
                "20220815/trajectory_01.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_01.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "fbac28e9765eb86380a3ecbc75d7fd71ee7283a4b6eda740f486b5d8d670bab3",
            ),
            RemoteFile(
                "20220815/trajectory_02.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_02.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "1dd18e2ef41511253b9d2ca2a51fd1a9cafe5eae7cb8280496f050cdae02db0d",
            ),
            RemoteFile(
                "20220815/trajectory_03.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_03.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "f686c90294ee11e371b949369f7bd80541c74fe358a4e5c28c52dd86e08ac398",
            ),
            RemoteFile(
                "20220815/trajectory_04.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_04.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "b9800f9fba977af0896617a0d535a67e33b20f54361ef3a025659c928dc50658",
            ),
            RemoteFile(
                "20220815/trajectory_05.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_05.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "e0352a2b381189beaab535df7da8a08a6a96dee72c0b5af3a43449734402f133",
            ),
            RemoteFile(
                "20220815/trajectory_11.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_11.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "b2a69f0087aa45cd9372247316eff12c573b9f7110d96ad80fe923e2badbff3b",
            ),
            RemoteFile(
                "20220815/trajectory_12.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_12.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "a5f61491c72ff648bc527f5c50f4d10b79a2f7b3b561f0fdcf4078d98581c0fd",
            ),
            RemoteFile(
                "20220815/trajectory_13.csv.gz",
                "data/experiment_records/design_A.0/20220815/sys_id/trajectory_13.csv",
                "e84ed2403b2d3971bbedd67a54c07551ddebdd60",
                "576bd0a89edf58750bb3b2e1ac880551550761b00407cd70e4e300c4db1fcec4",
            ),
            RemoteFile(
                "published_parameters/model_1.0.yml",
                "data/system_identification/identified_parameters/tmotors_v1.0/model_parameters.yml",
                "a6a124200036ad1ca66667bb7a4c2a9a9856d5d5",
                "65c09304af7885af409454383a2f14f7f48f0724fe0a26ccbc175d2df98365d9",
            ),
            RemoteFile(
                "published_parameters/model_2.0.yml",
                "data/system_identification/identified_parameters/design_A.0/model_2.0/model_parameters.yml",
                "a3fad8b929bbbe247cba7d2bd0ef2e78473d333f",
                "2c03ccd07dc64a9d737c1dc5eaa4bc3d51c76f702b6a2164348594de0b35e01e",
            ),
            RemoteFile(
                "published_parameters/model_2.1.yml",
                "data/system_identification/identified_parameters/design_A.0/model_2.1/model_parameters.yml",
                "7cd0ae27008c3ea86611927a00e47801433be0ad",
                "43d14672611ad9cef17e8151d3df18499b140e03106c569490ab9e7a1caa7bef",
            ),
        ),
    ),
    "pendulum": Source(
        "dfki-ric-underactuated-lab/torque_limited_simple_pendulum",
        "BSD-3-Clause",
        (
            RemoteFile(
                "ddp/data_desired.csv",
                "results/video_recorded_ddp_torque_limit/data_desired.csv",
                "86d96d01ac3471d34b49910c912d2360c1f8ced6",
                "6699a4d2c29811e86b31d8868f8f6a470e6fc51eecb0daa2d2c5c4dcc2a91c0b",
            ),
            RemoteFile(
                "ddp/data_measured.csv",
                "results/video_recorded_ddp/data_measured.csv",
                "c761de7813573a6674ebd94afb66b83e44ea9148",
                "14748fd189abae7b6392a016f2f0494b54bb2a8c014bc435a84b58dbecb2da35",
            ),
            RemoteFile(
                "direct_collocation/data_desired.csv",
                "results/video_recorded_direct_collocation/data_desired.csv",
                "c761de7813573a6674ebd94afb66b83e44ea9148",
                "f80b8835e611bbd62971b345b87a4c46306b18825677d6443bba8e5a09e8bf6a",
            ),
            RemoteFile(
                "direct_collocation/data_measured.csv",
                "results/video_recorded_direct_collocation/data_measured.csv",
                "c761de7813573a6674ebd94afb66b83e44ea9148",
                "c3f990980169815b93ab37078780e13803327dcb6fc9e019f2d261b988cdaf8f",
            ),
            RemoteFile(
                "ilqr/data_desired.csv",
                "results/control_method_ilqr/data_desired.csv",
                "fca72ac81dde31d9eb62f836d085084c668638c6",
                "f5847d66e54fe917f34ee2184bd219f31fc9e112ef415371593113b1b113b4c3",
            ),
            RemoteFile(
                "ilqr/data_measured.csv",
                "results/control_method_ilqr/data_measured.csv",
                "fca72ac81dde31d9eb62f836d085084c668638c6",
                "f678b8650c167b04476be244f1b2d807d3e0949c5d7b7fa58522164bdcad0afe",
            ),
            RemoteFile(
                "pd_identification/data_desired.csv",
                "results/20210525-023541-PM_pd_control/data_desired.csv",
                "bac9126f9487ab647dba507ba8d795e04dd08742",
                "dafa758caad5b48c32bb0dd6b9547a66599980568cc6d1a80af5c8838a263985",
            ),
            RemoteFile(
                "pd_identification/data_measured.csv",
                "results/20210611-040141-PM_pd/data_measured.csv",
                "86d96d01ac3471d34b49910c912d2360c1f8ced6",
                "3a5728e9c5530dd9066c0d7fda4c6a9bf50d86f94538629ace6d2508a7053469",
            ),
        ),
    ),
    "xl330_bench": Source(
        "Rhoban/bam",
        "Apache-2.0",
        (
            RemoteFile(
                "2026-01-15_10h28m10.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m10.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "679215b9bbc50fb95959ce6efe257179e91f1b31ff80df52f8263d9f59ac8204",
            ),
            RemoteFile(
                "2026-01-15_10h28m17.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m17.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "3d0dbbc5508530d7f63249bfcc8f9933c12b8e59909eef9b021038be69219e38",
            ),
            RemoteFile(
                "2026-01-15_10h28m24.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m24.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "1881386668c9dfa66850c7214be2a5d322c92cface018db161f49523b778bed1",
            ),
            RemoteFile(
                "2026-01-15_10h28m32.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m32.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "c34fd5cbbbf915d007afab009ead4dce1f5e29b171aa590967baf13bc69beb0e",
            ),
            RemoteFile(
                "2026-01-15_10h28m42.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m42.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "32d76ad79a52950a1457b87a422442045f4f3809ebcf26bad5274cc98d1e1230",
            ),
            RemoteFile(
                "2026-01-15_10h28m49.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m49.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "48471398d192c67037780bafc1bd9102caa0d0062ac6cb858061fd9c06112a3e",
            ),
            RemoteFile(
                "2026-01-15_10h28m57.json.gz",
                "bam/data.bak/processed/2026-01-15_10h28m57.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "92d054cf37a49379f0dd6271d920f8a85a393744b3d08c1f89e97a255175ba4a",
            ),
            RemoteFile(
                "2026-01-15_10h29m04.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m04.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "86337e9acdb95ac34cbf48e375a407e3dcdf674c7cffa4f6d8f82f04d7c97dff",
            ),
            RemoteFile(
                "2026-01-15_10h29m14.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m14.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "f283c4136a7215c5a537ad634d20f537e5a336e2af609492bd2d6aade6b50c5e",
            ),
            RemoteFile(
                "2026-01-15_10h29m21.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m21.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "d58d17d74df27283372e198f4bd437628054c8f4e7185a48244545d3fa5063ab",
            ),
            RemoteFile(
                "2026-01-15_10h29m29.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m29.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "e4375867cea77647788f8035a37a9ab356b6b1cebb0aad8c5aeb0336d7510226",
            ),
            RemoteFile(
                "2026-01-15_10h29m37.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m37.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "4e3e1d059424c0530de67919e5e20038631d7145662fd7f69be34ac3efc02b59",
            ),
            RemoteFile(
                "2026-01-15_10h29m47.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m47.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "932064f30186ce745c77dd4c6e25d7b247aea2e496cc33aefe3e884bcda50220",
            ),
            RemoteFile(
                "2026-01-15_10h29m54.json.gz",
                "bam/data.bak/processed/2026-01-15_10h29m54.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "d98925d044ad923eccea60eaa03dc5453f985183bf0459f46945b297a707b3d1",
            ),
            RemoteFile(
                "2026-01-15_10h30m02.json.gz",
                "bam/data.bak/processed/2026-01-15_10h30m02.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "4fed9230bf6a345216778f23b34bf92a62126c84188d5a7ec5d742d691e1bcce",
            ),
            RemoteFile(
                "2026-01-15_10h30m10.json.gz",
                "bam/data.bak/processed/2026-01-15_10h30m10.json",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "b642f484cc2928b0b782f09cab7bc30b6d6cbff2097f7b96b420a230a355fe62",
            ),
            RemoteFile(
                "published_parameters/m1.json",
                "bam/params/xl330/m1.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "c925e15c9d8e7ca69b9401c39c269b520c1f3c14bb7bf4a5d3e485e4fcf8ce24",
            ),
            RemoteFile(
                "published_parameters/m2.json",
                "bam/params/xl330/m2.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "274ae09eec1c980b4c356451306ea8c584ed25f1220e3b389d05bfd9431dc5af",
            ),
            RemoteFile(
                "published_parameters/m3.json",
                "bam/params/xl330/m3.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "65eb91a15b3cc76e8c28c3996cee740265529b49196adbd0468dac52cff0991d",
            ),
            RemoteFile(
                "published_parameters/m4.json",
                "bam/params/xl330/m4.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "6daa67ea0a094b5758aa555d26c8b9d59bea6d81e49b656bc107bd68a58ea7e7",
            ),
            RemoteFile(
                "published_parameters/m5.json",
                "bam/params/xl330/m5.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "e86b3dab715fc61ef5db6735ade6aefae99732c6b61ee47faad95a0030d9eb22",
            ),
            RemoteFile(
                "published_parameters/m6.json",
                "bam/params/xl330/m6.json",
                "ea216102c0624f313d0ca6c0ec8f384008ff56c6",
                "61c699362fb3fabdde93eeba5e1ad3bf4ef9ca2f71d03e316b1924ff005b20d3",
            ),
        ),
    ),
    "unbalanced_disk": Source(
        "GerbenBeintema/gym-unbalanced-disk",
        "BSD-3-Clause",
        (
            RemoteFile(
                "training-val-test-data.npz",
                "disc-benchmark-files/training-val-test-data.npz",
                "67deee0d2d28d93c6b0235ed1350b36a81c6aec3",
                "94416d13cdb8ae20d527722726810933c78027effec929327f4ac336f066b1cd",
            ),
        ),
    ),
}
