"""How selectors do on problems with known answers (`selection_problems.py`), and on rollout logs.

    python benchmarks/selection.py [--selectors auto thompson lints ucb1 linucb] [--problems clusters linear] [--seeds 50] [--workers 2]
    python benchmarks/selection.py --logs assets/logs/suite assets/logs/pick_place --half choose

A problem is made anew for every seed, and every selector sees the same. `regret` is what the best single policy would have had more, over all
decisions and in successes: below 0 where a selector gains by the context. A seed is `stuck` if most of the last quarter went to a policy worse than
the best by more than 0.05, or, where the context matters, if that quarter came to 0.05 less a decision than the best single policy.

A log's instances come in a random order, those of `--half` only, with `--preset`'s rewards, and at most 3,000 of them. Settings of `auto` were chosen
on seeds below 1000 of like problems and on the choosing half of `assets/logs/suite`; the default seeds had no part in that.

The last line is JSON: by selector the mean regret per 1000 decisions, the shares of stuck seeds and of problems on which no other of the selectors is
ahead beyond the error, and the milliseconds of one decision with its update; by problem the regrets.
"""

import argparse
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from selection_problems import PROBLEMS, Problem, names

from osel_sim.core.progress import progress
from osel_sim.selection.registry import make_selector, wanted_of

CLOSE = 0.05 + 1e-9
"""A policy that is worse by no more than this is not worth finding."""


@dataclass(frozen=True)
class Played:
    """What came of one selector on one problem of one seed.

    Attributes:
        regret: to the best single policy, in successes, over all decisions.
        stuck: see the module.
        milliseconds: of one decision with its update.
    """

    regret: float
    stuck: bool
    milliseconds: float
    decisions: int


def make_problem(name: str, seed: int, half: str | None, preset: str) -> Problem:
    """A problem of `selection_problems`, or a log's folder."""
    generator = np.random.default_rng([seed, *name.encode()])
    if name in PROBLEMS:
        return PROBLEMS[name](generator)
    contexts, rewards, costs, skills = _log(name, half, preset)
    order = generator.permutation(len(contexts))[:3000]
    known = np.isfinite(rewards[order])
    repeat = np.where(known, generator.random(known.shape), -1.0).argmax(axis=2)
    drawn = np.take_along_axis(rewards[order], repeat[:, :, None], axis=2)[:, :, 0]
    return Problem(contexts[order], np.nanmean(rewards[order], axis=2), drawn, costs=costs, skills=skills)


def play(name: str, problem: Problem, seed: int) -> Played:
    """Show a problem to a selector, which sees the rewards of its choices only."""
    decisions, count = problem.rewards.shape
    policies = names(count)
    told = {"expected_costs": None if problem.costs is None else dict(zip(policies, problem.costs.tolist(), strict=True)), "skills": problem.skills}
    selector = make_selector(name, policies, problem.contexts.shape[1], seed, **wanted_of(name, told))
    chosen = np.zeros(decisions, np.int64)
    start = time.process_time()
    for row, context in enumerate(problem.contexts):
        choice = selector.select(context)
        chosen[row] = policies.index(choice.policy)
        selector.update(context, choice, float(problem.rewards[row, chosen[row]]))
    milliseconds = 1e3 * (time.process_time() - start) / decisions
    means = problem.expected.mean(axis=0)
    lost = (problem.expected[:, means.argmax()] - problem.expected[np.arange(decisions), chosen]) / problem.scale
    last = slice(decisions * 3 // 4, None)
    stuck = (means[chosen[last]] < means.max() - CLOSE * problem.scale).mean() > 0.5 if problem.context_free else lost[last].mean() > CLOSE
    return Played(float(lost.sum()), bool(stuck), milliseconds, decisions)


def _job(job: tuple[str, int], selectors: list[str], half: str | None, preset: str) -> dict[str, Played]:
    problem = make_problem(*job, half, preset)
    return {name: play(name, problem, job[1]) for name in selectors}


@cache
def _log(folder: str, half: str | None, preset_name: str) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], object]:
    """Contexts (N, D), rewards (N, P, R), expected costs (P,) and skills of a log's complete instances."""
    import osel_sim as osel
    from osel_sim.analysis.streams import complete_instances
    from osel_sim.selection.reward import preset
    from osel_sim.selection.skills import Skills

    weights = preset(preset_name)
    log = osel.load_log(folder)
    mine = log.half(half) if half else np.ones(len(log), bool)
    costs = (log.take(~mine) if half else log).expected_costs(weights)
    log, _ = complete_instances(log.take(mine), weights)
    own = dict(zip(log.policies, names(len(log.policies)), strict=True))
    skills = log.skills and Skills(log.skills.examples, {own[policy]: declared for policy, declared in log.skills.able.items() if policy in own})
    return log.contexts, log.rewards(weights), np.array([costs[policy] for policy in log.policies]), skills


def _results(options: argparse.Namespace, problems: list[str]) -> Iterator[tuple[str, dict[str, list[Played]]]]:
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    job = partial(_job, selectors=options.selectors, half=options.half, preset=options.preset)
    with ProcessPoolExecutor(options.workers) as pool, progress(len(problems) * len(seeds), "seed", "selection") as bar:
        futures = {name: [pool.submit(job, (name, seed)) for seed in seeds] for name in problems}
        for name, own in futures.items():
            played = []
            for future in own:
                played.append(future.result())
                bar.update(1)
            yield name, {selector: [results[selector] for results in played] for selector in options.selectors}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--selectors", nargs="+", default=["auto", "thompson", "lints", "ucb1", "linucb"])
    parser.add_argument("--problems", nargs="*", choices=list(PROBLEMS), metavar="NAME", help="default: all")
    parser.add_argument("--logs", nargs="*", default=[], help="folders of rollout logs; alone, no made-up problem is played")
    parser.add_argument("--half", choices=("choose", "score"))
    parser.add_argument("--preset", default="oxe")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # of the workers: they share the cores
    made = options.problems if options.problems is not None else [] if options.logs else list(PROBLEMS)
    problems = [*made, *(str(Path(log)) for log in options.logs)]
    print(f"{'':34s}" + "".join(f"{name:>22s}" for name in options.selectors))
    regrets: dict[str, dict[str, float]] = {}
    stuck = {name: list[bool]() for name in options.selectors}
    milliseconds = {name: list[float]() for name in options.selectors}
    per_decision = {name: list[float]() for name in options.selectors}
    unbeaten = dict.fromkeys(options.selectors, 0)
    for problem, played in _results(options, problems):
        values = {name: np.array([one.regret for one in own]) for name, own in played.items()}
        errors = {name: float(own.std(ddof=1) / np.sqrt(len(own))) if len(own) > 1 else 0.0 for name, own in values.items()}
        regrets[problem] = {name: round(float(own.mean()), 2) for name, own in values.items()}
        for name, own in played.items():
            stuck[name] += [one.stuck for one in own]
            milliseconds[name].append(float(np.mean([one.milliseconds for one in own])))
            per_decision[name].append(float(np.mean([1e3 * one.regret / one.decisions for one in own])))
            ahead = [values[name] - values[other] for other in options.selectors if other != name]
            unbeaten[name] += all(gap.mean() <= 1.96 * gap.std(ddof=1) / np.sqrt(len(gap)) for gap in ahead)
        cells = (f"{regrets[problem][name]:9.1f} ±{errors[name]:5.1f} {100 * np.mean([one.stuck for one in played[name]]):3.0f}%" for name in played)
        print(f"{problem[-34:]:34s}" + "".join(f"{cell:>22s}" for cell in cells), flush=True)
    found = {
        name: {
            "regret_per_1000": round(float(np.mean(per_decision[name])), 2),
            "stuck": round(float(np.mean(stuck[name])), 4),
            "unbeaten": round(unbeaten[name] / len(problems), 3),
            "milliseconds": round(float(np.mean(milliseconds[name])), 3),
        }
        for name in options.selectors
    }
    print(json.dumps({"selectors": found, "regrets": regrets}))


if __name__ == "__main__":
    main()
