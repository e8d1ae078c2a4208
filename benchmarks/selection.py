"""How selectors do on problems with known answers (`selection_problems.py`), and on rollout logs.

    python benchmarks/selection.py [--selectors auto thompson lints ucb1 linucb] [--problems clusters linear] [--seeds 50] [--workers 2]
    python benchmarks/selection.py --logs assets/logs/suite assets/logs/pick_place --half choose

A problem is made anew for every seed, and every selector sees the same. `regret` is what the best single policy would have had more, over all
decisions and in successes: below 0 where a selector gains by the context. A seed is `stuck` if most of the last quarter went to a policy worse than
the best by more than 0.05, or, where the context matters, if that quarter came to 0.05 less a decision than the best single policy.

A log's instances come in a random order, those of `--half` only, with `--preset`'s rewards, and at most 3,000 of them. Settings of `auto` were chosen
on like problems drawn from other seeds and on the choosing half of `assets/logs/suite`; the default seeds had no part in that.

With `--results FILE` every seed is written there as soon as it was played, and what is there is not played again: a benchmark that was cut off,
or one of more seeds, goes on. Seeds come in turn, so an early end leaves some of every problem. Begin a new file after a change of the code.

It prints a table in Markdown: regret ± standard error. The last line is JSON: by selector the mean regret per 1000 decisions, the shares of stuck
seeds and of problems on which no other of the selectors is ahead beyond the error, and the milliseconds of one decision with its update; by problem
what the best single policy has, and of each selector the regret, its standard error and the share of stuck seeds.
"""

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from selection_problems import PROBLEMS, Problem, names

from osel_sim.core.progress import progress
from osel_sim.selection.registry import make_selector, wanted_of

OVERALL = {
    "regret_per_1000": "regret per 1000 decisions",
    "stuck": "share of stuck seeds",
    "unbeaten": "share of problems on which none is ahead",
    "milliseconds": "milliseconds a decision",
}
CLOSE = 0.05 + 1e-9
"""A policy that is worse by no more than this is not worth finding."""


@dataclass(frozen=True)
class Played:
    """What came of one selector on one problem of one seed.

    Attributes:
        best: what the best single policy has, in successes, over all decisions.
        regret: to that policy.
        stuck: see the module.
        milliseconds: of one decision with its update.
    """

    best: float
    regret: float
    stuck: bool
    milliseconds: float
    decisions: int


@dataclass(frozen=True)
class Job:
    """One seed of a problem, and who plays it."""

    problem: str
    seed: int
    selectors: tuple[str, ...]


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
    return Played(float(means.max()) * decisions / problem.scale, float(lost.sum()), bool(stuck), milliseconds, decisions)


def _job(job: Job, half: str | None, preset: str) -> list[Played]:
    problem = make_problem(job.problem, job.seed, half, preset)
    return [play(name, problem, job.seed) for name in job.selectors]


@cache
def _log(folder: str, half: str | None, preset_name: str) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], object]:
    """Contexts (N, D), rewards (N, P, R), expected costs (P,) and skills of a log's complete instances."""
    import osel_sim as osel
    from osel_sim.analysis.streams import complete_instances
    from osel_sim.selection.reward import RewardWeights, preset
    from osel_sim.selection.skills import Skills

    weights = RewardWeights(0.0, 0.0) if preset_name == "success" else preset(preset_name)
    log = osel.load_log(folder)
    mine = log.half(half) if half else np.ones(len(log), bool)
    costs = (log.take(~mine) if half else log).expected_costs(weights)
    log, _ = complete_instances(log.take(mine), weights)
    own = dict(zip(log.policies, names(len(log.policies)), strict=True))
    skills = log.skills and Skills(log.skills.examples, {own[policy]: declared for policy, declared in log.skills.able.items() if policy in own})
    return log.contexts, log.rewards(weights), np.array([costs[policy] for policy in log.policies]), skills


def play_all(jobs: list[Job], options: argparse.Namespace) -> dict[tuple[str, int, str], Played]:
    """What came of each problem, seed and selector; those of `options.results` are not played again."""
    path: Path | None = options.results
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path and path.exists() else []
    whole = [line for line in lines if line.endswith("\n")]  # the last may have been cut off
    done = {(row["problem"], row["seed"], row["selector"]): Played(**row["played"]) for row in map(json.loads, whole)}
    jobs = [Job(job.problem, job.seed, tuple(name for name in job.selectors if (job.problem, job.seed, name) not in done)) for job in jobs]
    jobs = [job for job in jobs if job.selectors]
    if path:
        path.write_text("".join(whole), encoding="utf-8")
    with ProcessPoolExecutor(options.workers) as pool, progress(len(jobs), "seed", "selection") as bar:
        futures = {pool.submit(_job, job, options.half, options.preset): job for job in jobs}
        for future in as_completed(futures):
            job = futures[future]
            rows = []
            for name, played in zip(job.selectors, future.result(), strict=True):
                done[job.problem, job.seed, name] = played
                rows.append(json.dumps({"problem": job.problem, "seed": job.seed, "selector": name, "played": asdict(played)}) + "\n")
            if path:
                with path.open("a", encoding="utf-8") as file:
                    file.writelines(rows)
            bar.update(1)
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--selectors", nargs="+", default=["auto", "thompson", "lints", "ucb1", "linucb"])
    parser.add_argument("--problems", nargs="*", choices=list(PROBLEMS), metavar="NAME", help="default: all")
    parser.add_argument("--logs", nargs="*", default=[], help="folders of rollout logs; alone, no made-up problem is played")
    parser.add_argument("--half", choices=("choose", "score"))
    parser.add_argument("--preset", default="oxe", help="of rewards; success for success alone")
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, help="a file for what was played, to go on from")
    options = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # of the workers: they share the cores
    made = options.problems if options.problems is not None else [] if options.logs else list(PROBLEMS)
    problems = [*made, *(str(Path(log)) for log in options.logs)]
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    played = play_all([Job(problem, seed, tuple(options.selectors)) for seed in seeds for problem in problems], options)
    print(f"\n| problem | decisions | best single | {' | '.join(options.selectors)} |\n|---|---|---|{'---|' * len(options.selectors)}")
    found: dict[str, dict[str, Any]] = {}
    unbeaten = dict.fromkeys(options.selectors, 0)
    for problem in problems:
        own = {name: [played[problem, seed, name] for seed in seeds] for name in options.selectors}
        regrets = {name: np.array([one.regret for one in ones]) for name, ones in own.items()}
        some = own[options.selectors[0]]
        found[problem] = {"decisions": some[0].decisions, "best_single": round(float(np.mean([one.best for one in some])), 2)}
        for name, ones in own.items():
            stuck = float(np.mean([one.stuck for one in ones]))
            figures = {"regret": regrets[name].mean(), "error": _error(regrets[name]), "stuck": stuck}
            found[problem][name] = {key: round(float(value), 4) for key, value in figures.items()}
            ahead = [regrets[name] - regrets[other] for other in options.selectors if other != name]
            unbeaten[name] += all(gap.mean() <= 1.96 * _error(gap) for gap in ahead)
        cells = (_cell(found[problem][name]) for name in options.selectors)
        name = problem if problem in PROBLEMS else Path(problem).name
        print(f"| {name} | {some[0].decisions} | {found[problem]['best_single']:.0f} | {' | '.join(cells)} |")
    overall = {
        name: {
            "regret_per_1000": round(float(np.mean([1e3 * own[name]["regret"] / own["decisions"] for own in found.values()])), 2),
            "stuck": round(float(np.mean([own[name]["stuck"] for own in found.values()])), 4),
            "unbeaten": round(unbeaten[name] / len(problems), 3),
            "milliseconds": round(float(np.mean([played[problem, seed, name].milliseconds for problem in problems for seed in seeds])), 3),
        }
        for name in options.selectors
    }
    for key, heading in OVERALL.items():
        print(f"| {heading} | | | {' | '.join(f'{own[key]:g}' for own in overall.values())} |")
    print(json.dumps({"selectors": overall, "problems": found}))


def _cell(own: dict[str, float]) -> str:
    """Regret, its standard error, and the share of stuck seeds where there are any."""
    return f"{own['regret']:.1f} ± {own['error']:.1f}" + (f" ({own['stuck']:.0%} stuck)" if own["stuck"] else "")


def _error(values: NDArray[np.float64]) -> float:
    """Standard error of the mean."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


if __name__ == "__main__":
    main()
