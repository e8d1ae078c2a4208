"""t-SNE picture of contexts: `python -m osel_sim.training.encoder.figure --data DIR --out docs/context_tsne.png`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from osel_sim.context.encoder import encode_many, load_encoder
from osel_sim.context.names import DEFAULT_ENCODER
from osel_sim.core.content import find
from osel_sim.core.errors import OselError

if TYPE_CHECKING:
    import altair as alt


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the contexts of unseen test instances, coloured by object, container and phrasing."""
    parser = argparse.ArgumentParser(prog="python -m osel_sim.training.encoder.figure", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="rendered scenes are kept here, and rendered if missing")
    parser.add_argument("--out", type=Path, required=True, metavar="PNG")
    parser.add_argument("--encoder", default=DEFAULT_ENCODER)
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--instances", type=int, default=600, help="test instances (default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        draw_contexts(options.encoder, options.task, options.data, options.out, options.instances)
    except OselError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def draw_contexts(encoder_name: str, task_name: str, data: Path, out: Path, count: int) -> None:
    """Encode `count` test instances, lay them out with t-SNE, and write the picture with the neighbour agreement in each title."""
    import altair as alt
    from sklearn.manifold import TSNE

    from osel_sim.formats.task_file import load_task_file
    from osel_sim.training.encoder.evaluate import chance, context_labels, neighbour_agreement
    from osel_sim.training.encoder.scenes import cached_scenes

    encoder, task = load_encoder(encoder_name), load_task_file(find("tasks", task_name))
    scenes = cached_scenes(data, task, count, "test", encoder.image_size)
    contexts = encode_many(encoder, [([image], text) for image, text in zip(scenes.images, scenes.instructions.tolist(), strict=True)])
    labels = context_labels(task, scenes)
    asked = np.char.add(labels["object"], labels["container"])
    means = {value: contexts[asked == value].mean(axis=0) for value in np.unique(asked)}
    residues = contexts[:, encoder.dimension // 2 :] - np.stack([means[value] for value in asked])[:, encoder.dimension // 2 :]
    points, residue_points = (TSNE(perplexity=30, init="pca", random_state=0).fit_transform(vectors) for vectors in (contexts, residues))
    panels = (
        ("object", "contexts by object", contexts, points),
        ("container", "contexts by container", contexts, points),
        ("phrasing", "contexts by phrasing", contexts, points),
        ("phrasing", "text part by phrasing, mean of its object and container taken off", residues, residue_points),
    )
    charts = []
    for name, title, vectors, places in panels:
        agree = f"{neighbour_agreement(vectors, labels[name]):.0%} of the 10 nearest agree ({chance(labels[name]):.0%} by chance)"
        charts.append(_dots(places, labels[name]).properties(title=alt.Title(title, subtitle=agree), width=480, height=480))
    title = f"Contexts of {count} unseen {task.name} instances, encoder {encoder_name} (t-SNE)"
    figure = alt.concat(*charts, columns=2, title=title).resolve_scale(color="independent", shape="independent")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.save(str(out), format="png")


def _dots(places: NDArray[np.float32], labels: NDArray[np.str_]) -> "alt.Chart":
    """Places (N, 2), a colour for each label and crosses for wordings that were held out."""
    import altair as alt

    names = [str(label).replace("_", " ") for label in labels]
    rows = [{"x": float(x), "y": float(y), "name": name} for (x, y), name in zip(places, names, strict=True)]
    domain = sorted(set(names))
    x, y = alt.X("x:Q", axis=None, scale=alt.Scale(zero=False)), alt.Y("y:Q", axis=None, scale=alt.Scale(zero=False))
    legend = alt.Legend(title=None, orient="bottom", columns=6, symbolLimit=0)
    shapes = ["cross" if name.startswith("held out") else "circle" for name in domain]
    color = alt.Color("name:N", scale=alt.Scale(domain=domain, scheme="tableau20"), legend=legend)
    shape = alt.Shape("name:N", scale=alt.Scale(domain=domain, range=shapes), legend=legend)
    chart: alt.Chart = alt.Chart(alt.InlineData(values=rows)).mark_point(filled=True, size=24, opacity=0.9).encode(x=x, y=y, color=color, shape=shape)
    return chart


if __name__ == "__main__":
    sys.exit(main())
