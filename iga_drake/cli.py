"""The `iga` command. Each subcommand imports what it needs when it runs.

Exit status: 0 for success, 1 for an episode that did not succeed, 2 for bad input (one line says
what was found and what to do).
"""

import argparse
import importlib
import json
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from iga_drake.errors import IgaDrakeError
from iga_drake.files import write_text

SUCCESS, FAILURE, BAD_INPUT = 0, 1, 2
ALIGNERS = ("icp", "iga", "iga-energy", "iga-paper", "dirreg", "dfm", "expert")


class CommandError(IgaDrakeError):
    """A command was asked for something that it can't do."""


def scenario_path(text: str) -> Path:
    """`text` as a path, or as the name of a file in `diagrams/` (with or without .yaml)."""
    from iga_drake.paths import diagrams_dir

    path = Path(text)
    if path.is_file():
        return path
    named = diagrams_dir() / f"{path.name.removesuffix('.yaml')}.yaml"
    if path.name == text and named.is_file():
        return named
    known = ", ".join(sorted(p.stem for p in diagrams_dir().glob("*.yaml")))
    raise CommandError(f"scenario {text}: no such file; name a YAML file or one of: {known}")


def _seed(text: str) -> int:
    """A seed, as argparse takes it: NumPy knows none below 0."""
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"{seed} found, an integer >= 0 expected")
    return seed


# simulate


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", help="scenario YAML, e.g. diagrams/stack.yaml")
    parser.add_argument(
        "--seed", type=_seed, default=0, help="scene, noise and aligner (default 0)"
    )
    parser.add_argument("--aligner", choices=ALIGNERS, help="default: the scenario's")
    parser.add_argument(
        "--split", choices=("test", "demonstration"), default="test", help="which object instances"
    )
    parser.add_argument("--meshcat", action="store_true", help="show the scene in a browser")
    parser.add_argument("--html", type=Path, metavar="OUT", help="write a replay to look at")
    parser.add_argument("--result", type=Path, metavar="JSON", help="write the result as JSON")


def _simulate(arguments: argparse.Namespace) -> int:
    from iga_drake.station.scenario import load_scenario
    from iga_drake.tasks.episode import run_episode

    scenario = load_scenario(scenario_path(arguments.scenario))
    live = arguments.meshcat or scenario.visualization.meshcat
    meshcat = None
    if live or arguments.html:
        from iga_drake.viewing.meshcat import start_meshcat

        meshcat = start_meshcat(scenario.visualization)
        meshcat.StartRecording(set_visualizations_while_recording=live)
        if live:
            print(f"meshcat: {meshcat.web_url()}", flush=True)
    result = run_episode(
        scenario,
        seed=arguments.seed,
        aligner=arguments.aligner,
        split=arguments.split,
        meshcat=meshcat,
        on_event=lambda line: print(line, flush=True),
    )
    if meshcat is not None:
        from iga_drake.viewing.replay import show_prediction, write_html

        meshcat.StopRecording()
        meshcat.PublishRecording()
        show_prediction(
            meshcat,
            target=result.target_points,
            grasped_E=result.grasped_points,
            X_WE=result.X_WE_predicted,
        )
        if arguments.html:
            write_html(meshcat, arguments.html)
            print(f"replay: {arguments.html}")
    if arguments.result:
        write_text(arguments.result, json.dumps(result.row()) + "\n")
    if live and sys.stdin.isatty():
        input("press Enter to end")
    return SUCCESS if result.success else FAILURE


# demonstrate


def _add_demonstrate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", help="scenario YAML, e.g. diagrams/stack.yaml")
    parser.add_argument("--count", type=int, default=5, help="demonstrations to keep (default 5)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--seed", type=_seed, default=0, help="seed of the first attempt")


def _demonstrate(arguments: argparse.Namespace) -> int:
    from iga_drake.demonstrations.demonstration import check_replaceable, write_demonstrations
    from iga_drake.station.scenario import load_scenario
    from iga_drake.tasks.episode import record_demonstrations

    scenario = load_scenario(scenario_path(arguments.scenario))
    check_replaceable(arguments.out)  # before minutes of recording
    demonstrations = record_demonstrations(
        scenario, count=arguments.count, first_seed=arguments.seed
    )
    write_demonstrations(arguments.out, demonstrations)
    print(f"{len(demonstrations)} demonstrations of '{demonstrations.task}' in {arguments.out}")
    return SUCCESS


# view


# what is looked at: module, its function that adds options, its function that shows
VIEWS = {
    "demonstrations": ("iga_drake.cli", "_add_view_demonstrations", "_view_demonstrations"),
    "shapes": ("iga_drake.viewing.shape_sheets", "add_view_shapes", "view_shapes"),
    "dataset": ("iga_drake.viewing.dataset_views", "add_view_dataset", "view_dataset"),
    "deformations": (
        "iga_drake.studies.deformations",
        "add_view_deformations",
        "view_deformations",
    ),
    "energy": ("iga_drake.studies.energy_views", "add_view_energy", "view_energy"),
    "reconstruction": (
        "iga_drake.studies.encoder_views",
        "add_view_reconstruction",
        "view_reconstruction",
    ),
}


def _add_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=VIEWS)


def _view(arguments: argparse.Namespace) -> int:
    return _run_part(VIEWS, "view", arguments)


def _run_part(
    parts: dict[str, tuple[str, str, str]], command: str, arguments: argparse.Namespace
) -> int:
    """Runs `iga command what` with options of its own; the module is imported only now."""
    name, add, run = parts[arguments.what]
    module = _delegate(name)
    parser = argparse.ArgumentParser(prog=f"iga {command} {arguments.what}")
    getattr(module, add)(parser)
    return int(getattr(module, run)(parser.parse_args(arguments.options)) or SUCCESS)


def _add_view_demonstrations(parser: argparse.ArgumentParser) -> None:
    parser.description = "Clouds and waypoints in 3D."
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--html", type=Path, metavar="OUT", help="write a page instead of serving one"
    )


def _view_demonstrations(arguments: argparse.Namespace) -> int:
    from iga_drake.demonstrations.demonstration import read_demonstrations
    from iga_drake.viewing.replay import demonstrations_html, serve_demonstrations

    demonstrations = read_demonstrations(arguments.folder)
    for index, demonstration in enumerate(demonstrations.demonstrations):
        metadata = ", ".join(f"{key} {value}" for key, value in demonstration.metadata.items())
        print(
            f"{demonstrations.task} {index}: {len(demonstration.grasped)} grasped points, "
            f"{len(demonstration.target)} target points, waypoints "
            f"{', '.join(demonstration.names)}; {metadata}"
        )
    if arguments.html:
        write_text(arguments.html, demonstrations_html(demonstrations))
        print(f"written: {arguments.html}")
    else:
        serve_demonstrations(demonstrations)
    return SUCCESS


# evaluate


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


# what is evaluated: module, its function that adds options, its function that evaluates
EVALUATIONS = {
    "ablations": ("iga_drake.studies.ablations", "add_ablations", "evaluate_ablations"),
    "tasks": ("iga_drake.cli", "_add_evaluate_tasks", "_evaluate_tasks"),
    "alignment": ("iga_drake.cli", "_add_evaluate_alignment", "_evaluate_alignment"),
    "deformations": (
        "iga_drake.studies.deformations",
        "add_evaluate_deformations",
        "evaluate_deformations",
    ),
    "familiarity": ("iga_drake.studies.familiarity", "add_arguments", "main"),
    "diagnosis": (
        "iga_drake.studies.diagnosis",
        "add_evaluate_diagnosis",
        "evaluate_diagnosis",
    ),
    "scaling": ("iga_drake.studies.scaling", "add_evaluate_scaling", "evaluate_scaling"),
    "diversity": ("iga_drake.studies.scaling", "add_evaluate_diversity", "evaluate_diversity"),
    "compare": ("iga_drake.studies.compare", "add_compare", "evaluate_compare"),
    "stabilisers": (
        "iga_drake.studies.stabilisers",
        "add_stabilisers",
        "evaluate_stabilisers",
    ),
    "training-log": (
        "iga_drake.studies.training_log",
        "add_training_log",
        "evaluate_training_log",
    ),
}


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=EVALUATIONS)


def _evaluate(arguments: argparse.Namespace) -> int:
    return _run_part(EVALUATIONS, "evaluate", arguments)


def _add_evaluate_tasks(tasks: argparse.ArgumentParser) -> None:
    tasks.description = "Success of whole episodes."
    tasks.add_argument("--tasks", type=_names, default=["grasp", "stack"], help="scenarios")
    tasks.add_argument("--trials", type=int, default=15)
    tasks.add_argument("--aligner", type=_names, default=["iga", "icp"])
    tasks.add_argument("--seed", type=_seed, default=0, help="seed of the first trial")
    tasks.add_argument("--split", choices=("test", "demonstration"), default="test")
    tasks.add_argument("--processes", type=int, default=1, help="episodes at a time")
    tasks.add_argument("--results", type=Path, help="results file to append to and to go on from")
    tasks.add_argument("--json", action="store_true", help="print the summary as JSON")


def _add_evaluate_alignment(alignment: argparse.ArgumentParser) -> None:
    alignment.description = "Pose error on generated samples."
    alignment.add_argument(
        "--aligner", type=_names, default=["iga", "icp", "oracle"], help="names, or oracle"
    )
    alignment.add_argument("--sets", type=_names, help="of samples (default: the paper's five)")
    alignment.add_argument("--count", type=int, default=100, help="samples of each set")
    alignment.add_argument("--results", type=Path, help="results file to append to and go on from")
    alignment.add_argument("--by-category", action="store_true", help="also by kind of object")
    alignment.add_argument("--weights", type=Path, help="weights of iga (default: the landed ones)")
    alignment.add_argument("--energy", type=Path, help="energy of iga (default: the landed one)")
    alignment.add_argument("--card", type=Path, help="write a model card of iga's weights")
    alignment.add_argument("--energy-card", type=Path, help="write one of its energy")
    alignment.add_argument("--json", action="store_true", help="print the errors as JSON")


def _evaluate_alignment(arguments: argparse.Namespace) -> int:
    from iga_drake.aligners.iga.aligner import default_energy, default_weights
    from iga_drake.aligners.iga.weights import ENERGY
    from iga_drake.aligners.registry import make_aligner
    from iga_drake.evaluation.alignment import (
        FIVE_SETS,
        HEADER,
        ORACLE,
        by_category,
        digest,
        evaluate_alignment,
        model_card,
    )

    weights = arguments.weights or default_weights()
    energy = arguments.energy or default_energy()
    own = {name: {"weights": weights, "energy": energy} for name in ("iga", "iga-energy")}
    summaries = []
    if not arguments.json:
        print(HEADER)
    for name in arguments.aligner:
        options: dict[str, Path] = own.get(name, {})
        aligner = None if name == ORACLE else make_aligner(name, **options)
        rows = []
        for chosen in arguments.sets or FIVE_SETS:
            summary, found = evaluate_alignment(
                aligner,
                chosen,
                arguments.count,
                results=arguments.results,
                version="+".join(digest(path) for path in options.values()),
            )
            summaries.append(summary)
            rows += found
            if not arguments.json:
                print(summary.rows(), flush=True)
        if arguments.by_category and not arguments.json:
            print(by_category(rows))
    if arguments.json:
        print(json.dumps([asdict(summary) for summary in summaries], indent=2))
    if arguments.card:
        write_text(arguments.card, model_card(weights, summaries))
    if arguments.energy_card:
        write_text(arguments.energy_card, model_card(energy, summaries, kind=ENERGY))
    return SUCCESS


def _evaluate_tasks(arguments: argparse.Namespace) -> int:
    from iga_drake.evaluation.task_success import Trial, evaluate, format_table, summarise
    from iga_drake.station.scenario import load_scenario

    if arguments.trials < 1:
        raise CommandError(f"--trials {arguments.trials}: at least 1 is needed")
    for option in ("tasks", "aligner"):
        if not getattr(arguments, option):
            raise CommandError(f"--{option}: empty, at least one name is needed")
    unknown = [name for name in arguments.aligner if name not in ALIGNERS]
    if unknown:
        raise CommandError(f"--aligner {unknown[0]}: unknown; one of: {', '.join(ALIGNERS)}")
    trials = []
    for name in arguments.tasks:
        path = scenario_path(name)
        task = load_scenario(path).task.name
        for aligner in arguments.aligner:
            for seed in range(arguments.seed, arguments.seed + arguments.trials):
                trials.append((task, Trial(scenario=str(path), aligner=aligner, seed=seed)))

    def show(result: Any) -> None:
        verdict = "success" if result.success else f"failure ({result.cause}): {result.reason}"
        print(f"{result.task} {result.aligner} seed {result.seed}: {verdict}", file=sys.stderr)

    results = evaluate(
        trials,
        split=arguments.split,
        processes=arguments.processes,
        results_file=arguments.results,
        on_result=show,
    )
    if arguments.json:
        document = {"summary": summarise(results), "trials": [asdict(r) for r in results]}
        print(json.dumps(document, indent=2))
    else:
        print(format_table(results))
    return SUCCESS


# benchmark and train: modules with `main(argv) -> int`, or `add_arguments(parser)` and
# `main(arguments) -> int`

DELEGATES = ("benchmark", "dataset", "evaluate", "shapes", "train", "view")
BENCHMARKS = ("data", "fusion", "inference", "ik", "paper-energy")


def _delegate(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and module.startswith(error.name):
            raise CommandError(f"this installation has no {module}: install a full one") from error
        raise


def _add_benchmark(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=BENCHMARKS)


def _benchmark(arguments: argparse.Namespace) -> int:
    name = arguments.what.replace("-", "_")
    module = _delegate(f"iga_drake.studies.benchmark_{name}")
    return _run_delegate(module, f"iga benchmark {arguments.what}", arguments.options)


def _add_nothing(parser: argparse.ArgumentParser) -> None:
    pass  # every option belongs to the module that runs


def _train(arguments: argparse.Namespace) -> int:
    module = _delegate("iga_drake.training.cli")
    return _run_delegate(module, "iga train", arguments.options)


def _dataset(arguments: argparse.Namespace) -> int:
    module = _delegate("iga_drake.dataset.cli")
    return _run_delegate(module, "iga dataset", arguments.options)


def _shapes(arguments: argparse.Namespace) -> int:
    module = _delegate("iga_drake.shapes.cli")
    return _run_delegate(module, "iga shapes", arguments.options)


def _run_delegate(module: Any, prog: str, options: Sequence[str]) -> int:
    if not hasattr(module, "add_arguments"):
        return int(module.main(list(options)) or SUCCESS)
    parser = argparse.ArgumentParser(prog=prog, description=module.__doc__)
    module.add_arguments(parser)
    return int(module.main(parser.parse_args(options)) or SUCCESS)


COMMANDS: dict[str, tuple[str, Callable[[Any], None], Callable[[Any], int]]] = {
    "simulate": ("run one episode of a scenario", _add_simulate, _simulate),
    "demonstrate": (
        "let the scripted expert record demonstrations",
        _add_demonstrate,
        _demonstrate,
    ),
    "view": ("look at demonstrations, shapes, samples, deformations", _add_view, _view),
    "evaluate": (
        "tasks, alignments and where their errors come from, deformations",
        _add_evaluate,
        _evaluate,
    ),
    "benchmark": ("time a part", _add_benchmark, _benchmark),
    "shapes": ("list families, write them as SDF, read meshes", _add_nothing, _shapes),
    "dataset": ("write samples to files, print their digests", _add_nothing, _dataset),
    "train": ("train the learned aligner", _add_nothing, _train),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `iga` with `arguments` (default: the process's) and returns its exit status."""
    parser = argparse.ArgumentParser(prog="iga", description="Few-shot manipulation in Drake.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, (text, add, _) in COMMANDS.items():
        helps = name not in DELEGATES  # they print their own
        add(commands.add_parser(name, help=text, description=text, add_help=helps))
    parsed, others = parser.parse_known_args(arguments)
    if others and parsed.command not in DELEGATES:
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    parsed.options = others
    # Drake sets its logger's level when it is imported, later than this: a filter stays.
    logging.getLogger("drake").addFilter(lambda record: record.levelno >= logging.WARNING)
    try:
        return COMMANDS[parsed.command][2](parsed)
    except IgaDrakeError as error:
        print(f"iga {parsed.command}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        return FAILURE
    except OSError as error:
        if error.filename is None:
            raise
        print(f"iga {parsed.command}: {error.filename}: {error.strerror}", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
