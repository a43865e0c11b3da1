"""Train GraspNet on simulated images, which are made first, or cross-validate it on real ones.

    python train_graspnet.py
    python train_graspnet.py --config configs/quick.yaml
    python train_graspnet.py train.backbone=ggcnn data.frames=2000
    torchrun --nproc_per_node=2 train_graspnet.py
    python train_graspnet.py data.kind=cornell data.root=path/to/cornell
    python train_graspnet.py train.initial=FILE.pt adaptation.target=path/to/photographs

The run folder runs/train_graspnet/<time>/ then holds best.pt (chosen on held-out training objects),
last.pt, graspnet.pt (the weights of best.pt alone), results.json, curves.png, predictions.png and
TensorBoard events (tensorboard --logdir runs/train_graspnet). Ctrl-C stops a training early;
--resume RUN continues it, bit for bit on the same device and number of processes.

On real data (data.kind cornell or jacquard) every fold of the images is tested by a network that is
trained on the other folds for a fixed schedule. The last weights count, so no test image chooses
anything. Each fold has its folder in the run's; results.json holds every prediction.

With adaptation.target, every step takes labelled simulated images and as many unlabelled
photographs, and the checkpoint is chosen without a label of these; see docs/sim_to_real.md.
"""

from __future__ import annotations

import os

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

# The processes that load images need the cores while a thread waits for another one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from envs.cell import camera_intrinsics
from envs.data_generation import data_folder, generate
from envs.registries import check_names
from models.graspnet_adaptation import AdaptingTrainer, check_alone, open_target, with_target
from models.graspnet_data import TrainingData, epoch_loader, simulated_data, steps_per_epoch
from models.graspnet_io import KIND, load_graspnet, save_graspnet
from models.graspnet_scores import (
    check_graspable,
    closing_words,
    draw_curves,
    draw_predictions,
    open_curves,
    row_in_words,
    write_curves,
)
from models.graspnet_training import Trainer, check_network, make_network, mean_of
from models.rectangle_examples import JudgedRectangle
from models.rectangle_folds import (
    Fold,
    cross_validation_results,
    describe_fold,
    describe_folds,
    real_folds,
    save_fold,
)
from utils.checkpoint import check_weights_file
from utils.config import COMPUTE_KEYS, Config
from utils.distributed import Team, run_folder, stop_on_interrupt, team, without_initial
from utils.errors import UserError
from utils.grasp_data import read_trials
from utils.grasp_labels import label_truth
from utils.run_checks import check_data, check_place, counted
from utils.runs import check_resume, parse_args, resume_command, run_script, save_results

WEIGHTS = "also write graspnet.pt to this file once the training has reached its end"
STOPPING = "interrupted: stopping after the step under way"
SAVE_SECONDS = 300  # between two saves of last.pt within an epoch
FREE_TO_CHANGE = (*COMPUTE_KEYS, "train.name", "train.device", "train.workers", "data.workers")


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Train GraspNet.", _add_options)
    check_names(config)
    check_weights_file("--weights", options.weights, KIND)
    check_resume(config, options.resume, FREE_TO_CHANGE, ["last.pt", "fold*/last.pt"])
    check_place(options.resume or Path("runs/train_graspnet"))
    check_network(without_initial(config, "train", options.resume))  # before there is data
    photographs = open_target(config)
    with team(config.train.device, os.environ) as processes:
        if config.data.kind != "simulated":
            return cross_validate(config, options, processes)
        learned = {"simulated images": data_folder(config).name}
        if photographs is not None:
            check_alone(processes)
            learned["adaptation.target"] = counted(photographs.names)
        check_data(options.resume, learned)  # before there are new data
        data = make_data(config, processes, options.resume is not None)
        if photographs is not None:
            data = with_target(config, data, photographs)
        trainer = make_trainer(without_initial(config, "train", options.resume), data, processes)
        with run_folder(
            "train_graspnet", config.train.name, config, options.resume, processes, learned
        ) as run:
            history, finished = train(config, run, data, trainer)

            if processes.is_main:
                # A half-trained network must not replace a finished one: no --weights then.
                scores = save_best(run, data, history, options.weights if finished else None)
                if scores and not trainer.was_finished:
                    print(closing_words(scores, run / "graspnet.pt"))
                if not finished:
                    go_on = resume_command("train_graspnet.py", run, {"--weights": options.weights})
                    print(f"stopped after {trainer.step} steps; go on with {go_on}")
    return 0 if finished else 130


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, metavar="FILE", help=WEIGHTS)


def make_data(config: Config, processes: Team, resumed: bool) -> TrainingData:
    """Make the simulated images that are still missing, and open them. Raises UserError if they
    make no batch, or if the validation images show nothing graspable."""
    steps_per_epoch(config, config.data.frames)
    folder = generate(config, processes.rank, processes.ranks)
    processes.wait()
    if processes.is_main and not resumed and (truth := label_truth(read_trials(folder))).positives:
        print(truth.describe())
    data = simulated_data(config, folder, float(camera_intrinsics(config.camera).K[0, 0]))
    check_graspable(data.validation)
    return data


def make_trainer(config: Config, data: TrainingData, processes: Team) -> Trainer:
    """Make a network with seeded weights, or those of train.initial, and its optimiser."""
    torch.manual_seed(config.seed)
    model = make_network(config, config.train.max_width or data.max_width, not processes.is_main)
    total_steps = steps_per_epoch(config, len(data.train)) * config.train.epochs
    if config.adaptation.target is not None:
        return AdaptingTrainer(model, config.train, total_steps, processes, config.adaptation)
    return Trainer(model, config.train, total_steps, processes)


def train(
    config: Config, run: Path, data: TrainingData, trainer: Trainer
) -> tuple[list[dict[str, float]], bool]:
    """Train from the folder's last.pt, if it is there, to the end of the schedule or to Ctrl-C.
    Returns the history, with a row of mean losses (of this process's examples) and scores for every
    epoch, and whether the end was reached."""
    processes, steps = trainer.team, steps_per_epoch(config, len(data.train))
    history, losses = trainer.resume(run / "last.pt")  # losses: of steps after history's last row
    save = partial(
        trainer.save, config=config, metres_per_pixel=data.metres_per_pixel, history=history
    )
    is_main = processes.is_main
    if is_main:
        print(trainer.announcement(config, len(data.train), run), flush=True)
    curves = open_curves(run / "tensorboard", trainer.step, is_main)
    quiet = not is_main or trainer.was_finished
    bar = tqdm(total=trainer.total_steps, initial=trainer.step, unit="step", disable=quiet)
    last_save = time.monotonic()
    with stop_on_interrupt(STOPPING if is_main else None) as interrupted, bar, curves as writer:
        for epoch in range(len(history), config.train.epochs):
            skip = trainer.step - epoch * steps
            for batch in epoch_loader(config, data, processes, epoch, skip):
                losses.append(trainer.train_step(batch))
                bar.update()
                bar.set_postfix(loss=f"{losses[-1]['loss']:.3f}", epoch=epoch + 1)
                stop = processes.any(interrupted.is_set())
                if is_main and (stop or time.monotonic() - last_save > SAVE_SECONDS):
                    save(run / "last.pt", losses=losses)
                    last_save = time.monotonic()
                if stop:
                    return history, False
            if is_main:
                row = {"epoch": epoch + 1, "step": trainer.step} | mean_of(losses)
                row |= data.score(trainer.model)
                history.append(row)
                data.keep_best(run, history, save)
                save(run / "last.pt", losses=[])
                write_curves(writer, row | {"lr": trainer.scheduler.get_last_lr()[0]})
                bar.write(row_in_words(row))
            losses = []
            processes.wait()
    return history, True


def save_best(
    run: Path, data: TrainingData, history: list[dict[str, float]], weights: Path | None
) -> dict[str, float]:
    """Save the best network alone, its scores, which are returned, curves and pictures."""
    if not history:  # stopped within the first epoch
        return {}
    best, network = load_graspnet(run / "best.pt"), run / "graspnet.pt"
    scores = best.extra["history"][-1]
    for path in filter(None, [network, weights]):
        save_graspnet(path, best.model, best.metres_per_pixel, best.config, scores=scores)
    save_results(run / "results.json", {"best": scores, "history": history}, run)
    draw_curves(run / "curves.png", history, scores["epoch"])
    for name, images in data.pictured().items():
        draw_predictions(run / f"{name}.png", best.model, images)
    return scores


def cross_validate(config: Config, options: argparse.Namespace, processes: Team) -> int:
    """Train and test a network for every fold of real images; returns the exit code."""
    if options.weights is not None and config.data.fold is None:
        raise UserError("--weights: every fold has a network of its own; choose one by data.fold")
    folds, name = real_folds(config), config.train.name
    learned = {
        f"fold {fold.number}": f"{counted(fold.train)}, tested on {counted(fold.test)}"
        for fold in folds
    }
    with run_folder("train_graspnet", name, config, options.resume, processes, learned) as run:
        return train_folds(config, folds, run, options, processes)


def train_folds(
    config: Config, folds: Sequence[Fold], run: Path, options: argparse.Namespace, processes: Team
) -> int:
    """The trainings of `cross_validate`, in the folder of their run."""
    judged: dict[int, list[JudgedRectangle]] = {}
    for fold in folds:
        folder = run / f"fold{fold.number}"
        trainer = make_trainer(without_initial(config, "train", folder), fold.data, processes)
        if processes.is_main:
            folder.mkdir(exist_ok=True)
        processes.wait()
        history, finished = train(config, folder, fold.data, trainer)
        if not finished:
            if processes.is_main:
                go_on = resume_command("train_graspnet.py", run, {"--weights": options.weights})
                print(f"stopped in fold {fold.number}; go on with {go_on}")
            return 130
        if processes.is_main:
            judged[fold.number] = fold.judge(trainer.model)
            save_fold(config, folder, fold, judged[fold.number], trainer.model, options.weights)
            draw_curves(folder / "curves.png", history)
            print(describe_fold(fold, judged[fold.number]), flush=True)
            save_results(run / "results.json", cross_validation_results(folds, judged), run)
        processes.wait()
    if processes.is_main:
        print(describe_folds(config, judged))
        print(f"every prediction: {run / 'results.json'} and {run / 'fold*' / 'predictions.png'}")
    return 0


if __name__ == "__main__":
    run_script(main)
