"""Two real processes for the tests of distributed training, and what they do in there."""

import multiprocessing
import os
import signal
import socket
import time
import traceback

import torch
from networks.samples import collected, networks
from training.tasks import arm_learner, repeat_learner

from torchrl_athletic.losses import SplitClipPPOLoss, SplitOptimizationStepper
from torchrl_athletic.networks import RunningNormalizer
from torchrl_athletic.training import (
    Checkpoints,
    CSVTable,
    NonFiniteError,
    Rollout,
    control_step,
    iterate,
    join_processes,
    standardized,
    train,
)
from torchrl_athletic.training.distributed import check_seeds_differ

FORKS = multiprocessing.get_context("forkserver")  # the libraries are imported once for all processes
FORKS.set_forkserver_preload(["torchrl_athletic.envs", "torchrl_athletic.training", "training.together"])


def together(folder, job, *arguments, count=2, seconds=60):
    """What a job gives back in each process, by rank; None of one that was killed."""
    folder.mkdir(parents=True, exist_ok=True)
    with socket.socket() as free:
        free.bind(("localhost", 0))
        told = {"MASTER_ADDR": "localhost", "MASTER_PORT": str(free.getsockname()[1])}
    told |= {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count)}
    files = [folder / f"{job.__name__}-{rank}.pt" for rank in range(count)]
    processes = []
    for rank, file in enumerate(files):
        here = told | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        processes.append(FORKS.Process(target=_run, args=(here, file, job, *arguments), daemon=True))
    for process in processes:
        process.start()
    end = time.monotonic() + seconds
    while any(process.is_alive() for process in processes) and time.monotonic() < end:
        time.sleep(0.02)
        if any(process.exitcode == -signal.SIGKILL for process in processes):
            break
    for process in processes:
        process.kill()
        process.join()
    assert time.monotonic() < end, f"{job.__name__} hung"
    if any(process.exitcode == -signal.SIGKILL for process in processes):
        return [None] * count  # whatever the other one said of it
    found = [torch.load(file, weights_only=False) for file in files]
    for made in found:
        assert not isinstance(made, str), made
    return found


def _run(told, file, job, *arguments):
    os.environ |= told
    torch.set_num_threads(1)
    try:
        made = job(join_processes(), *arguments)
    except BaseException:
        made = traceback.format_exc()
    torch.save(made, file)


def weights(learner):
    return torch.cat([p.detach().flatten() for p in (*learner.actor.parameters(), *learner.critic.parameters())])


def arranged(stepper, count):
    """Make the minibatches of one process those of ``count`` processes with rows of their own, of the same seed."""
    draw = stepper._order

    def order(samples):
        part = draw(samples // count)  # as each of them draws
        chunks = part.tensor_split(stepper.minibatches, -1)
        return torch.cat([chunk + k * part.shape[-1] for chunk in chunks for k in range(count)], -1)

    stepper._order = order


def update(processes, masked, critic_minibatches=1):
    """Update with half of the samples in each of two processes, or with all in one."""
    policy, value = networks(torch.float64)
    stepper = SplitOptimizationStepper(
        SplitClipPPOLoss(policy, value, clip_value=0.2),
        critic_minibatches=critic_minibatches,
        micro_batch=7,
        max_grad_norm=0.1,
        average=processes.average_ if processes.count > 1 else None,
    )
    batch = collected(policy, 64)
    if masked:
        batch["shifted_valid"] = torch.arange(64) % 5 < 1 + torch.arange(64) // 20  # more count in the second half
        batch["advantage"][~batch["shifted_valid"]] = torch.nan
    if processes.count == 1:
        arranged(stepper, 2)
    report = stepper.update(batch.chunk(processes.count)[processes.rank])
    del report["max_ratio"], report["ESS"], report["explained_variance"]  # which are no means of samples
    parameters = torch.cat([p.detach().flatten() for p in (*policy.parameters(), *value.parameters())])
    return {"parameters": parameters, "lr": stepper.actor_lr, **report.to_dict()}


def statistics(processes):
    """Moments and advantages of samples that lie elsewhere and are spread otherwise in each process."""
    torch.manual_seed(3)
    seen = torch.tensor([5.0, -2.0, 0.0]) + torch.randn(2, 40, 6, 3) * torch.tensor([0.5, 2.0, 7.0])
    seen[:, 20:] = 3 * seen[:, 20:] + 1
    normalizer = RunningNormalizer(3)
    for part in seen:
        normalizer.update(part.chunk(processes.count)[processes.rank], processes.moments)
    advantage = standardized(seen[0, ..., :1].chunk(processes.count)[processes.rank], processes)
    uneven = [torch.full((2,), 1.0 + 4 * processes.rank), torch.tensor(float(processes.rank))]
    processes.average_(uneven, torch.tensor(1.0 + 2 * processes.rank))
    unknown = [torch.tensor(torch.nan if processes.rank else 3.0)]
    processes.average_(unknown, torch.tensor(1.0 - processes.rank))
    means = torch.stack([*uneven[0], *unknown])
    return {"normalizer": normalizer.state_dict(), "advantage": advantage, "means": means}


def exact_learner(processes, num_envs=4):
    """Whose rows explore alike, whichever process has them."""
    learner = arm_learner(num_envs, processes=processes)
    rows, first = processes.share(num_envs), processes.first_row(num_envs)
    env, generator = learner.env, torch.Generator().manual_seed(5)

    def act(tensordict):
        tensordict = learner.actor(tensordict)
        noise = torch.randn(num_envs, 7, generator=generator)[first : first + rows]
        tensordict["action"] = tensordict["loc"] + tensordict["scale"] * noise
        tensordict["action_log_prob"] = learner.actor.get_dist(tensordict).log_prob(tensordict["action"])
        return tensordict

    learner.rollout = Rollout(
        env, learner.actor, learner.config.horizon, step=lambda tensordict: control_step(env, act, tensordict)
    )
    if processes.count == 1:
        arranged(learner.stepper, 2)
    return learner


def exact_training(processes):
    learner = exact_learner(processes)
    reports = [iterate(learner) for _ in range(3)]
    shown = {key: torch.stack([report[key] for report in reports]) for key in ("reward", "kl", "actor_lr")}
    return shown | {
        "weights": weights(learner),
        "normalizer": learner.normalizers["joint_position"].state_dict(),
        "seen": learner.samples,
    }


def training(processes, iterations=15):
    learner = repeat_learner(32, processes=processes)
    rewards = [iterate(learner)["reward"] for _ in range(iterations)]
    return {"rewards": torch.stack(rewards), "weights": weights(learner), "noise": torch.rand(4)}


def in_time(processes, minutes=0.02):
    """One of them is slow, or its clock is."""
    learner, evaluated = repeat_learner(8, processes=processes), []

    def slow(learner):
        time.sleep(0.1 * processes.rank)
        return iterate(learner)

    def evaluate():
        evaluated.append(learner.iteration)
        return {"error": float(processes.rank)}

    metrics = train(learner, minutes=minutes, evaluate=evaluate, evaluate_every=1000, progress=False, step=slow)
    return {"iterations": learner.iteration, "metrics": metrics, "evaluated": evaluated}


class Nowhere(Rollout):
    def __call__(self):
        batch = super().__call__()
        batch["next", "reward"][0, 3] = torch.nan
        return batch


def a_nan(processes):
    """In the environment of the second one, later on."""
    learner = arm_learner(processes=processes)
    iterate(learner)
    if processes.rank == 1:
        learner.rollout = Nowhere(learner.env, learner.actor, 6, keys=["joint_position"])
    try:
        iterate(learner)
    except NonFiniteError as error:
        return {"error": str(error)}


def cpus(processes):
    return processes.gather(os.sched_getaffinity(0))[processes.rank]


def alike(processes):
    torch.manual_seed(0)
    try:
        check_seeds_differ(processes)
    except ValueError as error:
        return {"error": str(error)}


def saved_training(processes, folder, iterations=5, victim=None):
    """Killed, if it shall be, when the victim is about to write what it knows after four iterations."""
    learner = arm_learner(processes=processes)
    state_dict = learner.state_dict

    def state_or_death():
        if learner.iteration == 4 and processes.rank == victim:
            os.kill(os.getpid(), signal.SIGKILL)
        return state_dict()

    learner.state_dict = state_or_death
    table = CSVTable(folder / "progress.csv")
    try:
        train(
            learner,
            iterations=iterations,
            checkpoints=Checkpoints(folder, keep=1),
            checkpoint_every=2,
            logger=table,
            progress=False,
        )
    except ValueError as error:
        return {"error": str(error)}
    return {"weights": weights(learner), "current": learner.rollout.current.clone(), "iteration": learner.iteration}
