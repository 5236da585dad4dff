#!/usr/bin/env python3
"""Shows recordings, or a running node, in Rerun: performers, cameras, keypoints, events.

    pip install "../..[bus]" rerun-sdk
    python to_rerun.py out/poses.mcap take.mcap              # opens the viewer
    python to_rerun.py out/poses.mcap --save take.rrd        # for `rerun take.rrd`
    python to_rerun.py --live

The timeline `capture` is the cameras' clock. World: right-handed, y up, metres.
"""

import argparse
import threading

import bundlemocap
import numpy as np
import rerun as rr
from bundlemocap import bus

# Okabe-Ito palette: safe for colour-blind people.
COLOURS = [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0)]
GREY = (138, 143, 152)


class Scene:
    """Logs messages to Rerun."""

    def __init__(self):
        self._parents, self._colours, self._offsets = {}, {}, {}
        rr.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)

    def log(self, topic, message):
        """Logs `message` of `topic`. Returns whether it is shown: ground truth and other messages are not."""
        parts = topic.split("/")
        if "truth" in parts:
            return False
        if isinstance(message, bus.Rig):
            for camera in message.cameras:
                self._camera(camera)
            return True
        actor = parts[3] if len(parts) > 3 and parts[2] == "actor" else None
        if isinstance(message, bus.Skeleton):
            self._parents[actor] = list(message.parents)
            return True
        if not isinstance(message, (bus.Event, bus.KeypointFrame, bus.Pose)):
            return False
        # The calibration may correct a camera's clock.
        offset = self._offsets.get(message.camera, 0) if isinstance(message, bus.KeypointFrame) else 0
        rr.set_time("capture", timestamp=np.datetime64(message.capture_time_ns + offset, "ns"))
        if isinstance(message, bus.KeypointFrame):
            self._keypoints(message)
        elif isinstance(message, bus.Pose):
            self._pose(actor, message)
        else:
            of = " ".join(name for name in (actor, message.camera) if name)
            rr.log("events", rr.TextLog(f"{message.kind} {of} {message.detail}"))
        return True

    def _camera(self, camera):
        path = f"world/cameras/{camera.name}"
        self._offsets[camera.name] = camera.time_offset_ns
        rotation = matrix(camera.camera_from_world_rotation)
        centre = -rotation.T @ np.array(camera.camera_from_world_translation_m)
        rr.log(path, rr.Transform3D(translation=centre, mat3x3=rotation.T), static=True)
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
        # Rerun has no lens distortion model: with a wide lens, keypoints are off near the edges.
        pinhole = rr.Pinhole(
            image_from_camera=[[fx, camera.skew_px, cx], [0, fy, cy], [0, 0, 1]],
            width=camera.width,
            height=camera.height,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.5,
        )
        rr.log(path, pinhole, static=True)

    def _keypoints(self, frame):
        points = [np.reshape(person.points, (-1, 3)) for person in frame.people]
        points = np.concatenate(points) if points else np.zeros((0, 3))
        seen = points[points[:, 2] > 0]
        path = f"world/cameras/{frame.camera}/keypoints"
        rr.log(path, rr.Points2D(seen[:, :2], radii=3, colors=(255, 255, 255)))

    def _pose(self, actor, pose):
        path = f"world/performers/{actor}"
        if bus.state_of(pose) == "lost":
            # Without this, Rerun goes on showing the last pose.
            rr.log(path, rr.Clear(recursive=True))
            return
        parents = self._parents.get(actor)
        joints = np.reshape(pose.joint_positions_m, (-1, 3))
        if parents is None or len(parents) != len(joints):
            return
        colour = self._colours.setdefault(actor, COLOURS[len(self._colours) % len(COLOURS)])
        colour = colour if bus.state_of(pose) == "tracking" else GREY
        bones = [joints[[parent, joint]] for joint, parent in enumerate(parents) if parent >= 0]
        path += "/provisional" if pose.provisional else ""
        rr.log(path, rr.LineStrips3D(bones, radii=0.02, colors=colour))


def matrix(quaternion):
    """The rotation matrix of a quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def show(paths):
    """Shows recordings of one take."""
    scene, count = Scene(), 0
    for path in paths:
        for topic, _, kind, payload in bundlemocap.read_messages(path):
            count += scene.log(topic, bus.decoded(kind, payload))
    return count


def follow(connect, stage):
    """Shows a running node until Ctrl-C."""
    scene, lock = Scene(), threading.Lock()

    def handle(sample):
        with lock:
            scene.log(str(sample.key_expr), bus.message_of(sample))

    with bus.open_session(connect) as session:
        topics = ["rig", "actor/*/skeleton", "events", "actor/*/events"]
        states = [bus.subscribe_samples(session, f"mocap/{stage}/{topic}", handle) for topic in topics]
        topics = ["actor/*/pose", "camera/*/keypoints"]
        streams = [bus.subscribe_stream_samples(session, f"mocap/{stage}/{topic}", handle) for topic in topics]
        print(f"{len(states) + len(streams)} subscriptions; Ctrl-C ends")
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            pass


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", help="MCAP files of one take")
    parser.add_argument("--live", action="store_true", help="show a running node")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="address of the node")
    parser.add_argument("--stage", default="stage", help="name of the capture volume")
    parser.add_argument("--save", metavar="FILE", help="write an .rrd file instead of opening the viewer")
    args = parser.parse_args()
    if args.live == bool(args.recordings):
        parser.error("give recordings, or --live")
    rr.init("bundlemocap", spawn=args.save is None)
    if args.save is not None:
        rr.save(args.save)
    if args.live:
        follow(args.connect, args.stage)
    else:
        print(f"{show(args.recordings)} messages")


if __name__ == "__main__":
    try:
        main()
    except bundlemocap.Error as error:
        raise SystemExit(str(error)) from None
