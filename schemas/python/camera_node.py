#!/usr/bin/env python3
"""A camera node: publishes the 2D keypoints of a detector.

Use `CameraNode` with your own detector:

    session = mocap.open_session()
    camera = CameraNode(session, "cam_1", size=(1920, 1080), format="body_25")
    camera.publish(people, capture_time_ns)      # for every image, even without people

As a program it replaces detectors: it publishes the keypoints and the calibration of a recording in
real time, with new capture times:

    pip install eclipse-zenoh protobuf grpcio-tools
    pip install ../..                                  # bundlemocap itself, for the recording
    python generate.py
    python camera_node.py ../../recordings/walk.mcap
"""

import argparse
import time

import mocap
from keypoint_frame_pb2 import KeypointFrame
from rig_pb2 import Rig


class CameraNode:
    """One camera. `name` is its name in the calibration, `size` the image size in pixels, `format` the
    keypoint format: body_25, body_25b, coco_17, halpe_26 or coco_wholebody_133."""

    def __init__(self, session, name, size, format, stage="stage"):
        self._name, self.size, self._format, self._frame = name, size, format, 0
        self._stream = mocap.Stream(session, f"mocap/{stage}/camera/{name}/keypoints")

    def publish(self, people, capture_time_ns, number=None):
        """`people` contains the points of each person in the order of the format: x and y in pixels
        and a confidence, 0 for a missing point. `capture_time_ns` is the middle of the exposure on a
        clock that all cameras share (PTP, or `time.time_ns()` of one computer when the image arrives,
        less exposure and transfer), not the time of detection. A millisecond of error is 0.8 mm at a
        walking hand. The best clock is the node's own: poses are due on it. `number` counts the images,
        also those that were skipped; without it, those that are published."""
        frame = KeypointFrame(
            camera=self._name,
            frame=self._frame if number is None else number,
            capture_time_ns=capture_time_ns,
            image_width=self.size[0],
            image_height=self.size[1],
            format=self._format,
        )
        for points in people:
            frame.people.add().points.extend(number for point in points for number in point)
        self._frame += 1
        self._stream.put(frame, capture_time_ns)


def triples(numbers):
    return list(zip(numbers[0::3], numbers[1::3], numbers[2::3]))


def recorded(path):
    """The calibration of a recording, or None, and its keypoint frames in order of capture time."""
    import bundlemocap

    rig, frames = None, []
    try:
        messages = bundlemocap.read_messages(path)
    except bundlemocap.Error as error:
        raise SystemExit(str(error)) from None
    for topic, _, kind, payload in messages:
        if "truth" in topic:
            continue
        if kind == "bundlemocap.v1.Rig":
            rig = Rig.FromString(payload)
        elif kind == "bundlemocap.v1.KeypointFrame":
            frames.append(KeypointFrame.FromString(payload))
    return rig, sorted(frames, key=lambda frame: frame.capture_time_ns)


def play(session, path, names, stage, seconds):
    rig, frames = recorded(path)
    frames = [frame for frame in frames if not names or frame.camera in names]
    if not frames:
        raise SystemExit(f"{path}: no keypoints of the requested cameras")
    start = time.time_ns() + 200_000_000
    if rig is not None:
        state = mocap.State(session, f"mocap/{stage}/rig")
        state.put(rig, start)
    cameras = {}
    for frame in frames:
        offset = frame.capture_time_ns - frames[0].capture_time_ns
        if seconds is not None and offset >= seconds * 1e9:
            break
        if frame.camera not in cameras:
            size = (frame.image_width, frame.image_height)
            cameras[frame.camera] = CameraNode(session, frame.camera, size, frame.format, stage)
        time.sleep(max(0, start + offset - time.time_ns()) * 1e-9)
        people = [triples(person.points) for person in frame.people]
        cameras[frame.camera].publish(people, start + offset, frame.frame)


def main():
    parser = argparse.ArgumentParser(description="Publishes the keypoints of a recording.")
    parser.add_argument("recording", help="an MCAP file")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="address of the node")
    parser.add_argument("--camera", action="append", help="publish only this camera; may be repeated")
    parser.add_argument("--stage", default="stage", help="name of the capture volume")
    parser.add_argument("--seconds", type=float, help="stop after this many seconds of the recording")
    args = parser.parse_args()
    with mocap.open_session(args.connect) as session:
        play(session, args.recording, args.camera, args.stage, args.seconds)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
