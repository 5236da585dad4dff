#!/usr/bin/env python3
"""Cameras from a recording: publishes its keypoints and its calibration in real time, with new capture times.

    pip install "../..[bus]"                           # bundlemocap; it needs Rust
    python camera_node.py ../../recordings/walk.mcap

With a detector of your own:

    session = bus.open_session()
    camera = bus.CameraNode(session, "cam_1", size=(1920, 1080), format="body_25")
    camera.publish(people, capture_time_ns)            # for every image, even without people
"""

import argparse
import time

from bundlemocap import Error, bus


def play(session, path, names, stage, seconds):
    rig, frames = bus.recorded(path)
    frames = [frame for frame in frames if not names or frame.camera in names]
    if not frames:
        raise SystemExit(f"{path}: no keypoints of the requested cameras")
    start = time.time_ns() + 200_000_000
    if rig is not None:
        state = bus.State(session, f"mocap/{stage}/rig")
        state.put(rig, start)
    cameras = {}
    for frame in frames:
        offset = frame.capture_time_ns - frames[0].capture_time_ns
        if seconds is not None and offset >= seconds * 1e9:
            break
        if frame.camera not in cameras:
            size = (frame.image_width, frame.image_height)
            cameras[frame.camera] = bus.CameraNode(session, frame.camera, size, frame.format, stage)
        time.sleep(max(0, start + offset - time.time_ns()) * 1e-9)
        people = [bus.triples(person.points) for person in frame.people]
        cameras[frame.camera].publish(people, start + offset, frame.frame)


def main():
    parser = argparse.ArgumentParser(description="Publishes the keypoints of a recording.")
    parser.add_argument("recording", help="an MCAP file")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="address of the node")
    parser.add_argument("--camera", action="append", help="publish only this camera; may be repeated")
    parser.add_argument("--stage", default="stage", help="name of the capture volume")
    parser.add_argument("--seconds", type=float, help="stop after this many seconds of the recording")
    args = parser.parse_args()
    with bus.open_session(args.connect) as session:
        play(session, args.recording, args.camera, args.stage, args.seconds)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
    except Error as error:
        raise SystemExit(str(error)) from None
