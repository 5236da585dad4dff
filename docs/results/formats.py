"""Reads each exported file with a program that is not ours, compares it with poses.mcap, and draws formats.png.

    pip install bpy numpy matplotlib usd-core ezc3d mcap-protobuf-support    # bpy 5.0 needs Python 3.11
    cargo run --release -- solve recordings/walk.mcap --out /tmp/walk
    for to in glb usda bvh trc c3d csv npz mot; do cargo run --release -- export /tmp/walk/poses.mcap --out /tmp/walk/take.$to; done
    python docs/results/formats.py /tmp/walk
"""

import sys
from pathlib import Path

import bpy
import ezc3d
import matplotlib.pyplot as plt
import numpy as np
from mathutils import Matrix, Vector
from mcap_protobuf.reader import read_protobuf_messages
from pxr import Usd, UsdGeom, UsdSkel

HERE, FOLDER = Path(__file__).parent, Path(sys.argv[1])
# The frames that are compared, and the one that is drawn.
FRAMES, DRAWN = range(0, 240, 10), 100
# From Blender's axes, z up and facing -y, to ours.
OURS = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def matrices(quaternions):
    """From x, y, z, w."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    return np.moveaxis(np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]), (0, 1), (-2, -1))


def rotations_of(vectors):
    """From rotation vectors."""
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    axis = vectors / np.maximum(angle, 1e-12)
    return matrices(np.concatenate([axis * np.sin(angle / 2), np.cos(angle / 2)], -1))


def chained(parents, local):
    """Rotations in the world from those in the parent."""
    world = local.copy()
    for joint, parent in list(enumerate(parents))[1:]:
        world[:, joint] = world[:, parent] @ local[:, joint]
    return world


class Truth:
    def __init__(self):
        poses, body = [], None
        for message in read_protobuf_messages(str(FOLDER / "poses.mcap")):
            kind = message.topic.rsplit("/", 1)[-1]
            if kind == "skeleton":
                body = message.proto_msg
            if kind == "pose":
                poses.append(message.proto_msg)
        self.names, self.parents = list(body.joint_names), list(body.parents)
        self.places = np.array([pose.joint_positions_m for pose in poses]).reshape(-1, 22, 3)
        local = np.array([[*pose.root_rotation, *pose.local_rotations] for pose in poses]).reshape(-1, 22, 4)
        self.local = matrices(local)
        self.world = chained(self.parents, self.local)

    def bones(self, places):
        return [(places[parent], places[joint]) for joint, parent in enumerate(self.parents) if parent >= 0]


def degrees(a, b):
    """The largest angle between rotations; precise also where it is small."""
    return float(np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8), 0, 1))).max())


def millimetres(a, b):
    return float(1000 * np.linalg.norm(a - b, axis=-1).max())


def open_in_blender(path):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 60
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif path.suffix == ".usda":
        bpy.ops.wm.usd_import(filepath=str(path))
    else:
        bpy.ops.import_anim.bvh(filepath=str(path), global_scale=0.01)
    return next(one for one in bpy.data.objects if one.type == "ARMATURE")


def show(path, frame):
    # Blender begins BVH at frame 1.
    bpy.context.scene.frame_set(frame + (path.suffix == ".bvh"))


def in_blender(path, truth):
    """Places and rotations, from the rest pose, of the joints in the world, in our axes."""
    armature = open_in_blender(path)
    places, turns = [], []
    for frame in FRAMES:
        show(path, frame)
        bones = [armature.pose.bones[name] for name in truth.names]
        world = [np.array(armature.matrix_world @ bone.matrix) for bone in bones]
        rest = [np.array(armature.matrix_world @ bone.bone.matrix_local) for bone in bones]
        places.append([OURS @ one[:3, 3] for one in world])
        unit = lambda one: one[:3, :3] / np.linalg.norm(one[:3, :3], axis=0)
        turns.append([OURS @ unit(one) @ unit(at_rest).T @ OURS.T for one, at_rest in zip(world, rest)])
    return np.array(places), np.array(turns)


def with_usd(path, truth):
    stage = Usd.Stage.Open(str(path))
    prim = next(prim for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton))
    query = UsdSkel.Cache().GetSkelQuery(UsdSkel.Skeleton(prim))
    names = [str(joint).rsplit("/", 1)[-1] for joint in query.GetJointOrder()]
    order = [names.index(name) for name in truth.names]
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    rest = np.array(query.GetJointWorldBindTransforms())[order, :3, :3]
    places, turns = [], []
    for frame in FRAMES:
        # Rows are axes.
        world = np.array(query.ComputeJointSkelTransforms(Usd.TimeCode(frame)))[order]
        places.append(unit * world[:, 3, :3])
        turns.append(world[:, :3, :3].transpose(0, 2, 1) @ rest)
    return np.array(places), np.array(turns)


def of_markers(names, points, truth):
    return np.stack([points[:, names.index(f"{name}_jc")] for name in truth.names], 1)


def with_ezc3d(path, truth):
    file = ezc3d.c3d(str(path))
    names = file["parameters"]["POINT"]["LABELS"]["value"]
    return of_markers(names, file["data"]["points"][:3].transpose(2, 1, 0) / 1000, truth)


def of_trc(path, truth):
    lines = path.read_text().splitlines()
    names = lines[3].split("\t")[2::3]
    rows = np.array([line.split("\t") for line in lines[5:] if line.strip()], float)
    return of_markers([name for name in names if name], rows[:, 2:].reshape(len(rows), -1, 3), truth)


def of_csv(path, truth):
    table = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding=None)
    of = lambda *axes: np.stack([np.stack([table[f"{name}_{axis}"] for axis in axes], -1) for name in truth.names], 1)
    return of("x", "y", "z"), chained(truth.parents, matrices(of("qx", "qy", "qz", "qw")))


def of_npz(path, truth):
    """SMPL's joints: forward kinematics from the body's own joints at rest; z up."""
    file = np.load(path)
    turns = rotations_of(file["poses"][:, :66].reshape(-1, 22, 3))
    # Its order is that of SMPL: breadth first.
    order = SMPL_ORDER
    parents = [-1] + [order.index(truth.names[truth.parents[truth.names.index(name)]]) for name in order[1:]]
    world = chained(parents, turns)
    rest, places = file["rest_joints"], np.zeros((len(turns), 22, 3))
    places[:, 0] = rest[0] + file["trans"]
    for joint, parent in list(enumerate(parents))[1:]:
        places[:, joint] = places[:, parent] + world[:, parent] @ (rest[joint] - rest[parent])
    mine = [order.index(name) for name in truth.names]
    y_up = np.roll(np.eye(3), 1, axis=1)
    return (places @ y_up.T)[:, mine], (y_up @ world)[:, mine]


SMPL_ORDER = ["pelvis", "l_hip", "r_hip", "spine1", "l_knee", "r_knee", "spine2", "l_ankle", "r_ankle", "spine3", "l_foot",
              "r_foot", "neck", "l_collar", "r_collar", "head", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist",
              "r_wrist"]


def of_mot(path, truth):
    """Angles of knees and elbows, and those between the bones of poses.mcap, degrees; hinges turn about one axis."""
    lines = path.read_text().splitlines()
    start = lines.index("endheader") + 1
    names = lines[start].split()
    rows = np.array([line.split() for line in lines[start + 1:]], float)
    at = {name: truth.places[:, index] for index, name in enumerate(truth.names)}
    worst, found = 0.0, {}
    for side in "lr":
        for angle, (a, b, c) in {f"knee_angle_{side}": ("hip", "knee", "ankle"), f"elbow_flex_{side}": ("shoulder", "elbow", "wrist")}.items():
            above, below = at[f"{side}_{b}"] - at[f"{side}_{a}"], at[f"{side}_{c}"] - at[f"{side}_{b}"]
            cosine = (above * below).sum(-1) / np.linalg.norm(above, axis=-1) / np.linalg.norm(below, axis=-1)
            found[angle] = rows[:, names.index(angle)]
            worst = max(worst, np.abs(np.degrees(np.arccos(cosine)) - found[angle]).max())
    return worst, found


def material(name, colour):
    made = bpy.data.materials.new(name)
    made.diffuse_color = (*colour, 1)
    made.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (*colour, 1)
    made.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.7
    return made


PAINTS = {"bones": lambda: material("bones", (0.0, 0.17, 0.45)), "markers": lambda: material("markers", (0.8, 0.3, 0.0))}


def add_bone(a, b, paint, radius=0.018):
    a, b = Vector(a), Vector(b)
    if (b - a).length < 1e-6:
        return
    bpy.ops.mesh.primitive_cone_add(vertices=16, radius1=radius, radius2=0.4 * radius, depth=(b - a).length)
    one = bpy.context.object
    one.matrix_world = Matrix.Translation((a + b) / 2) @ (b - a).to_track_quat("Z", "Y").to_matrix().to_4x4()
    one.data.materials.append(paint)


def add_marker(at, paint):
    bpy.ops.mesh.primitive_uv_sphere_add(segments=16, ring_count=8, radius=0.026, location=at)
    bpy.context.object.data.materials.append(paint)


def render(path, floor_centre):
    """Draws the scene from the front and from the left."""
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=60, location=(floor_centre.x, floor_centre.y, 0))
    bpy.context.object.data.materials.append(material("floor", (0.3, 0.3, 0.3)))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.rotation_euler = 1.8, (0.6, 0.3, 0.4)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    target = floor_centre + Vector((0, 0, 0.9))
    camera.location = target + Vector((2.4, -2.9, 0.7))
    camera.rotation_euler = (target - camera.location).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens = 55
    for one in (sun, camera):
        scene.collection.objects.link(one)
    world = scene.world or bpy.data.worlds.new("world")
    scene.world = world
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.9, 0.93, 1, 1)
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.5
    scene.camera, scene.render.engine = camera, "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 48, False
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y = 300, 380
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def draw(path, image, bones=(), markers=()):
    """`bones`, `markers`: places in our axes, which Blender does not read itself."""
    if path.suffix in (".glb", ".usda", ".bvh"):
        armature = open_in_blender(path)
        show(path, DRAWN)
        for one in [one for one in bpy.data.objects if one.name.startswith("Icosphere")]:
            bpy.data.objects.remove(one)
        at = {bone.name: armature.matrix_world @ bone.head for bone in armature.pose.bones}
        if path.suffix == ".bvh":
            paint = PAINTS["bones"]()
            for bone in armature.pose.bones:
                # The ends of the limbs and the head have no child.
                others = [child.head for child in bone.children] or [bone.tail]
                for other in others:
                    add_bone(armature.matrix_world @ bone.head, armature.matrix_world @ other, paint)
    else:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        place = lambda point: Vector(OURS.T @ np.asarray(point))
        at = {"pelvis": place(bones[0][0] if len(bones) > 0 else np.mean(markers, 0))}
        for a, b in bones:
            add_bone(place(a), place(b), PAINTS["bones"]())
        for point in markers:
            add_marker(place(point), PAINTS["markers"]())
    centre = at["pelvis"].copy()
    centre.z = 0
    render(image, centre)


def main():
    truth = Truth()
    take = lambda kind: FOLDER / f"take.{kind}"
    sampled = list(FRAMES)
    rows, images = [], []

    def row(file, reader, places, turns=None, whole=False):
        frames = slice(None) if whole else sampled
        rows.append([file, reader, f"{millimetres(places, truth.places[frames]):.4f}",
                     "" if turns is None else f"{degrees(turns, truth.world[frames]):.4f}"])

    for kind in ("glb", "usda", "bvh"):
        row(f".{kind}", "Blender", *in_blender(take(kind), truth))
    row(".usda", "usd-core", *with_usd(take("usda"), truth))
    c3d, trc = with_ezc3d(take("c3d"), truth), of_trc(take("trc"), truth)
    csv, npz = of_csv(take("csv"), truth), of_npz(take("npz"), truth)
    row(".c3d", "ezc3d", c3d, whole=True)
    row(".trc", "numpy", trc, whole=True)
    row(".csv", "numpy", *csv, whole=True)
    row(".npz", "numpy", *npz, whole=True)
    worst, angles = of_mot(take("mot"), truth)
    rows.append([".mot", "numpy", "", f"{worst:.4f}"])
    print("| file | read by | joints (mm) | rotations (degrees) |\n|---|---|---|---|")
    for line in rows:
        print(f"| {' | '.join(line)} |")

    shown = {kind: {} for kind in ("glb", "usda", "bvh")}
    shown["c3d"] = dict(markers=c3d[DRAWN])
    shown["trc"] = dict(markers=trc[DRAWN])
    shown["csv"] = dict(bones=truth.bones(csv[0][DRAWN]))
    shown["npz"] = dict(bones=truth.bones(npz[0][DRAWN]))
    figure, axes = plt.subplots(2, 4, figsize=(10, 6.4), constrained_layout=True)
    for axis, (kind, parts) in zip(axes.flat, shown.items()):
        image = FOLDER / f"{kind}.png"
        draw(take(kind), image, **parts)
        axis.imshow(plt.imread(image))
        axis.set_title(f".{kind}", fontsize=10)
        axis.axis("off")
    angle = axes.flat[7]
    for name, values in angles.items():
        angle.plot(np.arange(len(values)) / 60, values, label=name.replace("_", " "), linewidth=1)
    angle.set_title(".mot, degrees over seconds", fontsize=10)
    angle.legend(fontsize=6)
    figure.savefig(HERE / "formats.png", dpi=80)


main()
