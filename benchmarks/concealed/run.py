"""Diagnose robots whose physics is concealed, each in a process of its own, and score the answers.

    python benchmarks/concealed/run.py --split tuning --block single --limit 40 --jobs 2
    python benchmarks/concealed/run.py seal --seed 7          # commit to the sealed cases before they are run
    python benchmarks/concealed/run.py --split sealed --seed 7 --jobs 2
    python benchmarks/concealed/score.py --split sealed --seed 7

A case takes one to ten seconds to record and as long to diagnose as the diagnosis takes. What is done is kept, one file
a case, and skipped the next time. The process that diagnoses sees a model, recordings and names of a catalogue, nothing
else; the files kept hold answers and no truths, which the score draws anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import Value
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, Literal

import tyro
from tqdm import tqdm

sys.path.append(str(Path(__file__).parents[2]))

import torchrl_athletic
from benchmarks.concealed.cases import (
    BLOCKS,
    Case,
    Session,
    Split,
    beyond_nuisance,
    key_json,
    prepare,
    record,
    source_digest,
    visibility,
)
from torchrl_athletic.recordings import write_recording

COUNTS = {
    "single": 336, "nothing": 80, "nuisance": 80, "outside": 48, "leave_one_out": 56, "pairs": 60, "triples": 24,
    "unidentifiable": 40, "heldout": 28,
    "bare": 24,
}  # fmt: skip
"""Cases of each block in the whole proof: every effect at least twelve times alone, 160 without anything."""
KEY = Path("benchmarks/results/concealed_key.sha256")
Method = Literal["diagnosis", "naive_bic", "sysid", "pace", "oracle", "uan"]


@dataclass(frozen=True)
class Config:
    """Every field is a flag."""

    split: Split = "tuning"
    block: Literal[
        "all", "single", "nothing", "nuisance", "outside", "leave_one_out", "pairs", "triples", "unidentifiable",
        "heldout", "bare",
    ] = "all"  # fmt: skip
    limit: int | None = None
    """Cases of each block; all of the proof's if left out. The first ones of a block are a fair sample of it."""
    first: int = 0
    """Index of the first case."""
    share: float = 1.0
    """Share of each block's cases, for a quick look: 0.1 runs the first tenth."""
    seed: int = 0
    jobs: int = 2
    """Processes at a time."""
    timeout: float = 900.0
    """Time limit of a case [s]."""
    method: Method = "diagnosis"
    """What answers: the diagnosis or a baseline."""
    output: Path = Path("outputs/concealed")
    """One JSON a case goes into METHOD/ of it."""
    fresh: bool = False
    """Run again what is done."""
    keep: Path | None = None
    """Folder in which models and recordings are kept, to look at."""


@dataclass(frozen=True)
class Seal:
    """Write down the digest of all that the sealed cases of a seed hide, before any is run."""

    seed: int
    output: Path = KEY


def main(cfg: Config) -> None:
    blocks = BLOCKS if cfg.block == "all" else (cfg.block,)
    folder = cfg.output / cfg.method
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [(block, k) for block in blocks for k in range(cfg.first, cfg.first + _count(block, cfg))]
    names = {w: f"{name_of(cfg.split, *w, cfg.seed)}.json" for w in wanted}
    todo = [w for w in wanted if cfg.fresh or not is_done(folder / names[w], cfg.method)]
    print(f"{len(wanted)} cases, {len(wanted) - len(todo)} of them done")
    todo.sort(key=lambda w: (w[1] / max(_count(w[0], cfg), 1), w[0]))  # a run cut short has a share of every block
    with ProcessPoolExecutor(cfg.jobs, initializer=_pin, initargs=(Value("i", 0),)) as pool:
        pending = [pool.submit(run_case, cfg, block, k) for block, k in todo]
        for done in tqdm(as_completed(pending), total=len(pending), unit="case"):
            tqdm.write(done.result())


def _pin(counter: Synchronized[int]) -> None:
    """Give each worker, and what it starts, a processor of its own: many threads on few cores slow each other down."""
    if hasattr(os, "sched_setaffinity"):
        with counter.get_lock():
            mine, counter.value = counter.value, counter.value + 1
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[mine % len(cores)]})


def is_done(path: Path, method: Method = "diagnosis") -> bool:
    """Whether a case was drawn by the generator and answered by the program as they are now."""
    if not path.exists():
        return False
    kept = json.loads(path.read_text(encoding="utf-8"))
    return bool(kept.get("source") == source_digest() and kept.get("program") == program_digest(method))


def program_digest(method: Method) -> str:
    """Digest of the files that make an answer; probabilities are learnt from answers, and left out."""
    package = Path(torchrl_athletic.__file__).parent
    files = [Path(__file__).parent / "baselines.py"]
    if method in ("diagnosis", "oracle", "uan"):
        files = sorted(p for room in ("diagnosis", "effects") for p in (package / room).glob("*.py"))
    digest = hashlib.sha256()
    for path in files:
        if path.name != "calibration.py":
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _count(block: str, cfg: Config) -> int:
    return cfg.limit if cfg.limit is not None else max(1, round(cfg.share * COUNTS[block]))


def name_of(split: str, block: str, index: int, seed: int) -> str:
    """Name of a case's files, without drawing it."""
    return f"{split}-{block}-{seed}-{index:04d}"


def run_case(cfg: Config, block: str, index: int) -> str:
    """Record one case, have it answered, and keep the answer. Returns a line for the terminal."""
    name = name_of(cfg.split, block, index, cfg.seed)
    begin = time.monotonic()
    result: dict[str, Any] = {"case": name, "source": source_digest(), "program": program_digest(cfg.method)}
    try:
        session = prepare(cfg.split, block, index, cfg.seed)
        with tempfile.TemporaryDirectory(prefix="concealed_") as temporary:
            folder = Path(temporary) if cfg.keep is None else cfg.keep / name
            export(session, folder)
            result["generated_seconds"] = time.monotonic() - begin
            result |= answer(cfg, session.case, folder)
        result["visibility"] = visibility(session)
        result["beyond_nuisance"] = [bool(beyond_nuisance(t, session)) for t in session.case.truths]
    except subprocess.TimeoutExpired:
        result["error"] = f"not finished after {cfg.timeout:g} s"
    except Exception as error:  # a case that fails is a result, and must not stop the others
        result["error"] = f"{type(error).__name__}: {error}"[-2000:]
    path = cfg.output / cfg.method / f"{name}.json"
    temporary_path = path.with_suffix(".part")
    temporary_path.write_text(json.dumps(result, indent=1), encoding="utf-8")
    temporary_path.replace(path)
    return f"{name}  {time.monotonic() - begin:6.1f} s  {result.get('error', '')[-200:]}"


def export(session: Session, folder: Path) -> None:
    """Write what the diagnosis may see: the model, the takes to fit, and those kept aside."""
    for part, takes in zip(("fit", "aside"), record(session), strict=True):
        (folder / part).mkdir(parents=True, exist_ok=True)
        for take in takes:
            write_recording(take, folder / part / f"{take.source}.npz")
    (folder / "model.xml").write_text(session.model_xml, encoding="utf-8")


def answer(cfg: Config, case: Case, folder: Path) -> dict[str, Any]:
    """What the method says of a folder, from a fresh interpreter.

    Raises:
        RuntimeError: If it failed.
    """
    here = Path(__file__).parent
    command = [sys.executable, str(here / "diagnose_case.py"), str(folder)]
    if cfg.method == "oracle":
        command += ["--only", *({t.effect for t in case.truths} or {"none"})]
    elif cfg.method == "uan":
        command += ["--uan", "2"]
    elif cfg.method != "diagnosis":
        command = [sys.executable, str(here / "baselines.py"), str(folder), "--method", cfg.method]
    if case.removed:
        command += ["--without", *case.removed]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=cfg.timeout,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(done.stderr[-1500:])
    content: dict[str, Any] = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
    return content


def seal(cfg: Seal) -> None:
    """Draw all sealed cases of the seed, and add the digest of the key; the truths are not shown."""
    if digest_of(cfg.seed, cfg.output) is not None:
        raise SystemExit(f"{cfg.output} has a digest of seed {cfg.seed}, which stays as it is. Take another seed.")
    digest = hashlib.sha256(key_json("sealed", cfg.seed, COUNTS).encode()).hexdigest()
    cfg.output.parent.mkdir(parents=True, exist_ok=True)
    with cfg.output.open("a", encoding="utf-8") as file:
        file.write(f"{digest}  sealed seed {cfg.seed}, {sum(COUNTS.values())} cases\n")
    print(f"{digest} added to {cfg.output}. Commit it before the run.")


def digest_of(seed: int, path: Path = KEY) -> str | None:
    """The committed digest of a seed's key, None if there is none."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return next((line.split()[0] for line in lines if f"seed {seed}," in line), None)


if __name__ == "__main__":
    if sys.argv[1:2] == ["seal"]:
        seal(tyro.cli(Seal, args=sys.argv[2:]))
    else:
        main(tyro.cli(Config))
