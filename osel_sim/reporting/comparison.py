"""A comparison as rows of text, which the terminal and Markdown show alike, and as JUnit XML."""

import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from osel_sim.core.shown import shown

Rows = list[tuple[str, ...]]
"""The headings first."""

SHARES = ("success", "subgoals")
"""Measures that are told in percent, and their differences in points."""


MARKDOWN_FLIPS = 100
"""Most instances that are listed in Markdown: a comment on a pull request holds 65,536 characters."""


def difference_rows(entry: Mapping[str, Any]) -> Rows:
    """What two policies came to, a row a measure."""
    rows: Rows = [("", entry["first"], entry["second"], "difference [95%]", "instances")]
    for name, found in entry["differences"].items():
        label = {"price": "price (cents)"}.get(name, name)
        ends = [_value(name, found[side], found) for side in ("first", "second")]
        rows.append((label, *ends, _difference(name, found), str(found["instances"])))
    return rows


def task_rows(entry: Mapping[str, Any]) -> Rows:
    """The difference of success on each task; headings alone where there is one task."""
    rows: Rows = [("task", entry["first"], entry["second"], "difference [95%]", "p (Holm)", "", "instances")]
    for task, found in entry["tasks"].items():
        ends = [_value("success", found[side], found) for side in ("first", "second")]
        rows.append((task, *ends, _difference("success", found), probability(found["p_holm"]), found["decision"] or "", str(found["instances"])))
    return rows


def pair_rows(result: Mapping[str, Any]) -> Rows:
    """All pairs of more than two policies."""
    rows: Rows = [("first", "second", "difference of success [95%]", "p", "p (Holm)", "second is", "instances")]
    for entry in result["pairs"]:
        test, success = entry["test"], entry["differences"]["success"]
        numbers = probability(test["p"]), probability(test["p_holm"])
        rows.append(
            (entry["first"], entry["second"], _difference("success", success), *numbers, entry["verdict"]["decision"], str(entry["instances"]))
        )
    return rows


def plan_rows(result: Mapping[str, Any]) -> Rows:
    """Instances needed, a row a pair."""
    rows: Rows = [("first", "second", "instances", "discordant", "to detect", "needed", "more", "for no worse by", "needed")]
    for entry in result["plan"]:
        detect, margin = (f"{100 * entry[name]:g} points" for name in ("detect", "margin"))
        no_worse = "-" if entry["needed_for_no_worse"] is None else str(entry["needed_for_no_worse"])
        seen = str(entry["instances"]), f"{100 * entry['discordant']:.1f}%"
        rows.append((entry["first"], entry["second"], *seen, detect, str(entry["needed"]), str(entry["more"]), margin, no_worse))
    return rows


def notes(entry: Mapping[str, Any]) -> list[str]:
    """What is to be known of a pair of policies beside its tables."""
    first, second, test, unpaired = entry["first"], entry["second"], entry["test"], entry["unpaired"]
    more = f", of repeats: {entry['pairs_of_repeats']}" if entry["pairs_of_repeats"] > entry["instances"] else ""
    found = [
        f"Pairs of instances: {entry['instances']}{more}. {second} is higher on {test['gained']} and lower on {test['lost']} "
        f"({test['method']}: p {probability(test['p'], sign=True)})."
    ]
    if unpaired["first"] or unpaired["second"]:
        found.append(f"Left out, without a counterpart: {unpaired['first']} instances of {first}, {unpaired['second']} of {second}.")
    if entry["errors"]["first"] or entry["errors"]["second"]:
        found.append(
            f"Episodes that ended in error are nobody's failure: {entry['errors']['first']} of {first}, {entry['errors']['second']} of {second}."
        )
    if entry["looks"]:
        found.append(
            f"Stopped by what it showed, after {entry['looks']} looks: the interval and the p of success hold at every one of them, "
            "those of tasks and other measures are those of a fixed number of instances."
        )
    if entry["same_scene"] < entry["instances"]:
        known = f" of {entry['instances'] - entry['same_scene']} of them" if entry["same_scene"] else ""
        found.append(f"Paired by key alone: the logs do not tell the scenes{known} (of an earlier version, or from elsewhere).")
    found += [f"No {name}: {reason}." for name, reason in entry["missing"].items()]
    worse = [task for task, part in entry["tasks"].items() if part["decision"] == "worse"]
    if worse and entry["verdict"]["decision"] != "worse":
        found.append(f"Yet {second} is worse on {', '.join(worse)}.")
    return found


def losses_first(entry: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Instances whose success changed, those that the second lost before those that it gained."""
    return sorted(entry["flips"], key=lambda flip: float(flip["second"] - flip["first"]))


def letter_rows(result: Mapping[str, Any]) -> Rows:
    """The compact letter display: policies that share a letter were not told apart."""
    return [("policy", "letters"), *(result["letters"] or {}).items()]


def probability(value: float, sign: bool = False) -> str:
    """A p to three digits; `sign`: with what stands before it in a sentence."""
    return "< 0.001" if value < 0.001 else f"{'= ' if sign else ''}{value:.3f}"


def markdown(result: Mapping[str, Any]) -> str:
    """The whole comparison for a pull request."""
    parts = [f"**{_marked(result['verdict']['text'])}**"]
    first = result["policies"][0]["name"]
    if len(result["policies"]) > 2:
        parts += [_table(pair_rows(result)), _table(letter_rows(result)), "Policies that share a letter were not told apart."]
    for entry in result["pairs"]:
        if entry["first"] != first:
            continue
        parts += [_table(difference_rows(entry)), *map(_marked, notes(entry))]
        if entry["tasks"]:
            parts.append(_table(task_rows(entry)))
        if entry["flips"]:
            rows: Rows = [("instance", entry["first"], entry["second"])]
            rows += [(flip["instance"], f"{flip['first']:.2g}", f"{flip['second']:.2g}") for flip in losses_first(entry)[:MARKDOWN_FLIPS]]
            rest = f", of which {MARKDOWN_FLIPS} are listed" if len(entry["flips"]) > MARKDOWN_FLIPS else ""
            parts.append(f"<details><summary>{len(entry['flips'])} instances changed{rest}</summary>\n\n{_table(rows)}\n\n</details>")
    return "\n\n".join(parts) + "\n"


def junit(result: Mapping[str, Any]) -> str:
    """A test case for each policy that is compared with the first: worse fails it, not enough data skips it."""
    first = result["policies"][0]["name"]
    entries = [entry for entry in result["pairs"] if entry["first"] == first]
    decisions = [entry["verdict"]["decision"] for entry in entries]
    failures, skipped = decisions.count("worse"), decisions.count("not enough data")
    counts = {"tests": str(len(entries)), "failures": str(failures), "errors": "0"}
    suite = ElementTree.Element("testsuite", {"name": "osel_sim.compare", **counts, "skipped": str(skipped), "time": "0"})
    for entry in entries:
        name = shown(f"{entry['second']} against {first}")
        case = ElementTree.SubElement(suite, "testcase", {"classname": "osel_sim.compare", "name": name, "time": "0"})
        kind, told = {"worse": "failure", "not enough data": "skipped"}.get(entry["verdict"]["decision"]), shown(entry["verdict"]["text"])
        if kind:  # some readers show the message, some the text
            ElementTree.SubElement(case, kind, {"message": told, **({"type": "worse"} if kind == "failure" else {})}).text = told
        lines = [entry["verdict"]["text"], *notes(entry), *("  ".join(row) for row in (*difference_rows(entry), *task_rows(entry)[1:]))]
        ElementTree.SubElement(case, "system-out").text = shown("\n".join(lines))
    suites = ElementTree.Element("testsuites", counts)
    suites.append(suite)
    ElementTree.indent(suites)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(suites, encoding="unicode") + "\n"


def _value(name: str, value: float, found: Mapping[str, Any]) -> str:
    return f"{100 * value:.1f}%" if name in SHARES else f"{value:.{_digits(name, found)}f}"


def _difference(name: str, found: Mapping[str, Any]) -> str:
    factor, digits = (100.0, 1) if name in SHARES else (1.0, _digits(name, found))
    ends = "" if found["ci95"] is None else " [{:+.{d}f}, {:+.{d}f}]".format(*(factor * end for end in found["ci95"]), d=digits)
    return f"{factor * found['difference']:+.{digits}f}{ends}"


def _digits(name: str, found: Mapping[str, Any]) -> int:
    """One for steps, three for rewards and scores, two for the rest, and more where prices are by the token."""
    usual = {"steps": 1, "reward": 3, "score": 3}.get(name, 2)
    largest = max(abs(found["first"]), abs(found["second"]))
    return usual if largest == 0.0 or largest >= 0.1 or name == "steps" else 5


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    lines = [f"| {' | '.join(map(_marked, row))} |" for row in rows]
    return "\n".join([lines[0], "|" + " --- |" * len(rows[0]), *lines[1:]])


def _marked(text: str) -> str:
    """A text of others as Markdown shows it, in one line: no markup, no HTML, no end of a cell, and nobody and nothing mentioned or linked."""
    text = " ".join(shown(text).split()).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = "".join(f"\\{character}" if character in "\\`*_{}[]|#@~!$" else character for character in text)
    # Servers look for names and addresses in what was rendered, where an escape is gone; an empty comment stays.
    return re.sub(r"(?<!\w)\\[@#](?=\w)|://|(?i:\bwww\.)", lambda found: f"{found[0]}<!-- -->", text)
