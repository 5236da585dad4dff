"""Draws claim.svg: the paper's path relative to MuVS, from the folders of `bundlemocap eval`.

The folder given has the results of the commands in solver.md, "Where the published result holds":
studio and sparse of `eval ablation`; walking-X and sitting-X of `eval recording`, where X is the number
of cameras (c2), N of every Nth frame (e2), or the added errors in pixels (j10).
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt

ROWS = {"BundleMoCap (paper, converged, body)": ":", "+ tuned weights": "-"}
REFERENCE = "MuVS"
TAKES = {"walking": "#009e73", "sitting": "#cc79a7"}
LEVELS = {"studio": "#0072b2", "sparse": "#d55e00"}
folder = Path(sys.argv[1])


def ratios(methods, error):
    """The error of each row in cameras that are left out, by that of MuVS."""
    errors = {name: error(method) for name, method in methods.items()}
    return [errors[row] / errors[REFERENCE] for row in ROWS]


def by_name(rows):
    return {row["method"]: row for row in rows}


def synthetic(level, factor):
    factors = json.loads((folder / level / "results.json").read_text())["factors"]
    [values] = [of["values"] for of in factors if of["factor"] == factor]
    return [(of["value"], ratios(by_name(row["summary"] for row in of["methods"]),
                                 lambda row: row["mean"]["held_out_px"])) for of in values]


def real(take, letter):
    found = []
    for path in folder.glob(f"{take}-{letter}*/results.json"):
        value = int(path.parent.name.split("-")[1][1:])
        rows = by_name(json.loads(path.read_text())["methods"])
        found.append((value, ratios(rows, lambda row: row["hold_out_px"])))
    return sorted(found)


plt.rcParams.update({"font.size": 8, "svg.hashsalt": "claim", "svg.fonttype": "none"})
figure, axes = plt.subplots(2, 3, figsize=(9, 5.2), sharey=True, constrained_layout=True)


def draw(axis, points, colour):
    for row, style in enumerate(ROWS.values()):
        axis.plot([x for x, _ in points], [y[row] for _, y in points], style, color=colour, marker=".")


PANELS = [("noise", "error scale (1: the level)", None, None),
          ("new_share", "share of errors new in each frame", None, None),
          (None, "real takes: errors added in each frame (px)", "j", None),
          ("cameras", "cameras", "c", None),
          ("fps", "frames/s", "e", lambda every: 60 / every)]
for axis, (factor, label, letter, turn) in zip(axes.flat, PANELS):
    for level, colour in LEVELS.items() if factor else ():
        points = synthetic(level, factor)
        draw(axis, [(x, y) for x, y in points if factor != "noise" or level == "studio" or x <= 2], colour)
    for take, colour in TAKES.items() if letter else ():
        draw(axis, [(turn(x) if turn else x, y) for x, y in real(take, letter)], colour)
    axis.axhline(1, color="#444444", linewidth=0.8)
    axis.set(xlabel=label, yscale="log", ylim=(0.5, 2.0), yticks=[0.5, 0.7, 1, 1.4, 2])
    axis.set_yticks([], minor=True)
    axis.set_yticklabels(["0.5", "0.7", "1", "1.4", "2"])
for axis in axes[:, 0]:
    axis.set_ylabel("held-out error relative to MuVS")
legend = axes.flat[-1]
legend.axis("off")
for name, colour in {**LEVELS, **TAKES}.items():
    legend.plot([], [], color=colour, label=name)
for name, style in zip(("published weights", "weights of a sweep"), ROWS.values()):
    legend.plot([], [], style, color="#444444", label=name)
legend.legend(loc="center", frameon=False, title="BundleMoCap as published, converged;\nbelow 1 it is ahead")
figure.savefig(Path(__file__).with_suffix(".svg"), metadata={"Date": None})
