"""Train GraspNet: simulated data (made first if they are not there), checkpoints, curves, pictures.

    python train_graspnet.py
    python train_graspnet.py --config configs/quick.yaml
    python train_graspnet.py train.backbone=ggcnn data.frames=2000
    torchrun --nproc_per_node=2 train_graspnet.py
    python train_graspnet.py data.kind=cornell data.root=path/to/cornell
    python train_graspnet.py train.initial=FILE.pt adaptation.target=path/to/photographs

Leaves best.pt (chosen on held-out training objects), last.pt, graspnet.pt (the best one's weights
alone), results.json, curves.png, predictions.png and TensorBoard events in
runs/train_graspnet/<time>/. Ctrl-C stops early; --resume RUN goes on where it was, bit for bit on
the same device and number of processes.

On real data (data.kind cornell or jacquard) it cross-validates: every fold of the images is tested
by a network that is trained on the other folds for a fixed schedule. The last weights count, so no
test image chooses anything. Each fold has its folder in the run's; results.json holds every
prediction.

With adaptation.target, labelled simulated images and unlabelled photographs are shown in turn, and
the checkpoint is chosen without a label of the latter; see docs/sim_to_real.md.
"""

from __future__ import annotations

import os

# The processes that load images need the cores while a thread waits for another one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import math
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from envs.camera import camera_intrinsics
from envs.data_generation import generate
from envs.registries import check_names
from models.graspnet import GraspNet, create_model
from models.graspnet_adaptation import AdaptingTrainer, check_alone, open_target, with_target
from models.graspnet_data import TrainingData, simulated_data
from models.graspnet_examples import EpochBatches
from models.graspnet_io import load_graspnet, load_initial, save_graspnet
from models.graspnet_scores import check_graspable, draw_curves, draw_predictions
from models.graspnet_training import Trainer
from models.rectangle_examples import Judged, draw_rectangles
from models.rectangle_folds import (
    Fold,
    cross_validation_results,
    describe_fold,
    describe_folds,
    real_folds,
)
from utils.config import Config, parse_args, run_script
from utils.distributed import Team, stop_on_interrupt, team
from utils.errors import UserError
from utils.grasp_data import read_trials
from utils.grasp_labels import label_truth
from utils.runs import check_resume, check_writable, new_run_folder, save_results, write_atomic

SAVE_SECONDS = 300  # between two saves of last.pt within an epoch
WEIGHTS_HELP = "also write graspnet.pt here, once the training has reached its end"
FREE_TO_CHANGE = ("train.name", "train.device", "train.workers", "data.workers")


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Train GraspNet.", _add_options)
    check_names(config)
    check_writable("--weights", options.weights)
    check_resume(config, options.resume, FREE_TO_CHANGE, ["last.pt", "fold*/last.pt"])
    check_network(config)
    photographs = open_target(config)
    with team(config.train.device, dict(os.environ)) as us:
        if config.data.kind != "simulated":
            return cross_validate(config, options.resume, options.weights, us)
        if photographs is not None:
            check_alone(us)  # before work is put into the data
        data = make_data(config, us)
        if photographs is not None:
            data = with_target(config, data, photographs)
        trainer = make_trainer(config, data, us)
        run = options.resume or Path(us.broadcast(us.is_main and open_run(config)))
        history, losses = load_progress(trainer, run / "last.pt")
        if us.is_main:
            announce(config, run, data, trainer)

        finished = train(config, run, data, trainer, history, losses)

        if us.is_main:
            # A network that is half trained must not replace one that is not.
            save_training(run, data, history, options.weights if finished else None)
            if not finished:
                print(f"stopped after {trainer.step} steps; go on with --resume {run}")
    return 0 if finished else 130


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, metavar="FILE", help=WEIGHTS_HELP)


def check_network(config: Config) -> None:
    """Raise UserError for a network that cannot be made, before work is put into its data."""
    make_network(config, max_width=1.0)


def make_data(config: Config, us: Team) -> TrainingData:
    """What to train on; simulated images are made here as far as they lack.

    Raises UserError if the validation images could not tell a good network from a bad one.
    """
    folder = generate(config, us.rank, us.ranks)
    us.wait()
    truth = label_truth(read_trials(folder))
    if us.is_main and truth.positives:
        low, high = truth.precision_ci95
        print(
            f"labels against physics: {truth.executed} executed, precision "
            f"{100 * truth.precision:.1f} % [{100 * low:.1f}, {100 * high:.1f}] of "
            f"{truth.positives} positive ones, recall {100 * truth.recall_weighted:.0f} %"
        )
    camera = config.camera
    focal, distance = camera_intrinsics(camera).K[0, 0], math.dist(camera.position, camera.target)
    data = simulated_data(config, folder, float(focal), distance)
    check_graspable(data.validation)
    return data


def open_run(config: Config) -> str:
    return str(new_run_folder("train_graspnet", config.train.name, config))


def make_trainer(config: Config, data: TrainingData, us: Team) -> Trainer:
    """A new network, or one that starts from train.initial, and its optimiser."""
    torch.manual_seed(config.seed)
    model = make_network(config, config.train.max_width or data.max_width)
    total_steps = steps_per_epoch(config, data) * config.train.epochs
    if config.adaptation.target is not None:
        return AdaptingTrainer(model, config.train, total_steps, us, config.adaptation)
    return Trainer(model, config.train, total_steps, us)


def make_network(config: Config, max_width: float) -> GraspNet:
    """The network that the config asks for. Only simulated images tell centres of mass, so only a
    network that learns from them has a head for these."""
    model = create_model(
        name=config.train.backbone,
        max_width=max_width,
        centre_head=config.data.kind == "simulated" and config.train.centre_weight > 0,
    )
    if config.train.initial is not None:
        load_initial(model, config.train.initial)
    return model


def steps_per_epoch(config: Config, data: TrainingData) -> int:
    batch = config.train.batch_size
    if len(data.train) < batch:
        raise UserError(f"train.batch_size is {batch}, but there are only {len(data.train)} images")
    return len(data.train) // batch


def announce(config: Config, run: Path, data: TrainingData, trainer: Trainer) -> None:
    parameters = sum(p.numel() for p in trainer.model.parameters())
    to = f", adapted to {config.adaptation.target}" if config.adaptation.target else ""
    print(
        f"GraspNet {config.train.backbone}, {parameters:,} parameters, on {len(data.train)} "
        f"{config.data.kind} images{to}, for {config.train.epochs} epochs, {trainer.team.ranks} "
        f"process(es), {trainer.team.device}, {str(trainer.precision).removeprefix('torch.')}, "
        f"seed {config.seed}; results in {run}",
        flush=True,
    )


def load_progress(trainer: Trainer, last: Path) -> tuple[list[dict], list[dict]]:
    """History and losses (see `train`) of a checkpoint that the trainer goes on from, if there is
    one."""
    saved = trainer.load(last) if last.is_file() else {}
    return saved.get("history", []), saved.get("losses", [])


def train(
    config: Config, run: Path, data: TrainingData, trainer: Trainer,
    history: list[dict], losses: list[dict],
) -> bool:  # fmt: skip
    """Train to the end of the schedule, or until Ctrl-C; whether the end was reached.

    history gets a row an epoch: mean losses and the scores on the validation images. losses: of
    the steps already taken in the epoch that history lacks.
    """
    us, steps = trainer.team, steps_per_epoch(config, data)
    writer = SummaryWriter(run / "tensorboard", purge_step=trainer.step) if us.is_main else None
    bar = tqdm(total=trainer.total_steps, initial=trainer.step, unit="step", disable=not us.is_main)
    last_save = time.monotonic()
    with stop_on_interrupt() as interrupted, bar:
        for epoch in range(len(history), config.train.epochs):
            for batch in batches(config, data, us, epoch, skip=trainer.step - epoch * steps):
                losses.append(trainer.train_step(batch))
                bar.update()
                bar.set_postfix(loss=f"{losses[-1]['loss']:.3f}", epoch=epoch + 1)
                if us.any(interrupted.is_set()):
                    save_last(run, config, data, trainer, history, losses)
                    return False
                if time.monotonic() - last_save > SAVE_SECONDS:
                    save_last(run, config, data, trainer, history, losses)
                    last_save = time.monotonic()
            if us.is_main:
                row = {"epoch": epoch + 1, "step": trainer.step} | mean_of(losses)
                row |= data.score(trainer.model)
                history.append(row)
                keep_best(run, config, data, trainer, history)
                save_last(run, config, data, trainer, history, losses=[])
                for name, value in row.items():
                    writer.add_scalar(name, value, trainer.step)
                writer.add_scalar("lr", trainer.scheduler.get_last_lr()[0], trainer.step)
                writer.flush()
                bar.write(", ".join(f"{name} {value:.4g}" for name, value in row.items()))
            losses = []
            us.wait()
    return True


def keep_best(
    run: Path, config: Config, data: TrainingData, trainer: Trainer, history: list[dict]
) -> None:
    """Have best.pt hold the weights of the epoch that `data.chosen` names, if it names one."""
    chosen = data.chosen(history)
    if data.keeps_every_epoch:
        this, best = (run / f"epoch{row['epoch']}.pt" for row in (history[-1], chosen))
        trainer.save(this, config, data.metres_per_pixel, history=history)
        write_atomic(run / "best.pt", best.read_bytes())
    elif chosen is history[-1]:
        trainer.save(run / "best.pt", config, data.metres_per_pixel, history=history)


def batches(config: Config, data: TrainingData, us: Team, epoch: int, skip: int) -> DataLoader:
    """This process's part of the batches of one epoch from number `skip` on."""
    sampler = EpochBatches(
        len(data.train), config.train.batch_size, config.seed, epoch, skip, us.rank, us.ranks
    )
    workers = config.train.workers
    workers = max(1, (os.cpu_count() or 1) // us.ranks) if workers is None else workers
    return DataLoader(
        data.train,
        batch_sampler=sampler,
        num_workers=workers,
        worker_init_fn=ignore_interrupt,
        pin_memory=us.device.type == "cuda",
    )


def save_last(
    run: Path, config: Config, data: TrainingData, trainer: Trainer,
    history: list[dict], losses: list[dict],
) -> None:  # fmt: skip
    if trainer.team.is_main:
        progress = {"history": history, "losses": losses}
        trainer.save(run / "last.pt", config, data.metres_per_pixel, **progress)


def mean_of(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def ignore_interrupt(worker: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


def save_training(run: Path, data: TrainingData, history: list[dict], weights: Path | None) -> None:
    """The best network alone, its scores, and pictures of how it came about and what it does."""
    if not history:  # stopped within the first epoch
        return
    best = load_graspnet(run / "best.pt")
    scores = best.extra["history"][-1]
    for path in filter(None, [run / "graspnet.pt", weights]):
        save_graspnet(path, best.model, best.metres_per_pixel, best.config, scores=scores)
    save_results(run / "results.json", {"best": scores, "history": history})
    draw_curves(run / "curves.png", history)
    for name, images in data.pictured().items():
        draw_predictions(run / f"{name}.png", best.model, images)
    print(f"best after epoch {scores['epoch']}: {data.chosen_by} {scores[data.chosen_by]:.3f}")
    print(f"score it: python evaluate.py evaluate.policies=heuristic,{run / 'graspnet.pt'}")


# --- Real data: cross-validation ------------------------------------------------------------


def cross_validate(config: Config, resume: Path | None, weights: Path | None, us: Team) -> int:
    """Train and test a network for every fold; results so far are saved after each."""
    if weights is not None and config.data.fold is None:
        raise UserError("--weights: every fold has a network of its own; choose one by data.fold")
    folds = real_folds(config)
    run = resume or Path(us.broadcast(us.is_main and open_run(config)))
    judged: dict[int, list[Judged]] = {}
    for fold in folds:
        folder = run / f"fold{fold.number}"
        trainer = make_trainer(config, fold.data, us)
        history, losses = load_progress(trainer, folder / "last.pt")
        if us.is_main:
            folder.mkdir(exist_ok=True)
            announce(config, folder, fold.data, trainer)
        us.wait()
        if not train(config, folder, fold.data, trainer, history, losses):
            if us.is_main:
                print(f"stopped in fold {fold.number}; go on with --resume {run}")
            return 130
        if us.is_main:
            judged[fold.number] = fold.judge(trainer.model)
            save_fold(config, folder, fold, judged[fold.number], trainer, history, weights)
            print(describe_fold(fold, judged[fold.number]), flush=True)
            results = cross_validation_results(folds, judged)
            save_results(run / "results.json", results)
        us.wait()
    if us.is_main:
        print(describe_folds(config, judged))
        print(f"every prediction: {run / 'results.json'} and {run / 'fold*' / 'predictions.png'}")
    return 0


def save_fold(
    config: Config, folder: Path, fold: Fold, judged: Sequence[Judged], trainer: Trainer,
    history: Sequence[dict], weights: Path | None,
) -> None:  # fmt: skip
    """A fold's network alone, its curves, and pictures of all its test images."""
    right = sum(one.correct for one in judged)
    for path in filter(None, [folder / "graspnet.pt", weights]):
        save_graspnet(
            path, trainer.model, fold.data.metres_per_pixel, config.model_dump(mode="json"),
            scores={"correct": right, "images": len(judged)},
        )  # fmt: skip
    draw_curves(folder / "curves.png", history)
    draw_rectangles(folder / "predictions.png", fold.test_samples, judged)


if __name__ == "__main__":
    run_script(main)
