"""The bus of a running node: sessions, publishers, subscribers and messages. `pip install ".[bus]"` brings what it needs.

The messages of `schemas/*.proto` are classes here, such as `bus.Pose`. The payload of a zenoh sample is such a message, its
encoding names the message, its attachment is the capture time in nanoseconds: 8 bytes, little endian.
"""

import contextlib
import json
import os
import pathlib
import platform
import re
import struct
import sys
import uuid
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import zenoh
import zenoh.ext
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # type: ignore[import-untyped]

from . import Error, read_messages, schemas

_PACKAGE = "bundlemocap.v1"
_SCHEMAS = schemas()
_pool = descriptor_pool.DescriptorPool()
for _files in _SCHEMAS.values():
    for _file in descriptor_pb2.FileDescriptorSet.FromString(_files).file:
        _pool.AddSerializedFile(_file.SerializeToString())


def __getattr__(name: str) -> Any:
    try:
        return message_factory.GetMessageClass(_pool.FindMessageTypeByName(f"{_PACKAGE}.{name}"))
    except KeyError:
        raise AttributeError(f"bundlemocap.bus has no message {name}") from None


def message_of(sample: zenoh.Sample) -> Any:
    """The message in a sample, or None if it is not one of ours."""
    return decoded(str(sample.encoding).partition(";")[2], sample.payload.to_bytes())


def decoded(kind: str, payload: bytes) -> Any:
    """A message from its full name, such as bundlemocap.v1.Pose, and its bytes; None if it is not one of ours."""
    if kind not in _SCHEMAS:
        return None
    return __getattr__(kind.rpartition(".")[2]).FromString(payload)


def state_of(pose: Any) -> str:
    """The state of a pose in words: tracking, coasting or lost; else unknown."""
    words = {1: "tracking", 2: "coasting", 3: "lost"}
    return words.get(pose.state, "unknown")


def open_session(connect: str = "tcp/127.0.0.1:7447") -> zenoh.Session:
    """A session as client of the node at this address."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    try:
        config.insert_json5("connect/endpoints", json.dumps([connect]))
    except zenoh.ZError as error:
        raise Error(f"{connect!r} is no address, such as tcp/127.0.0.1:7447 ({error})") from None
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "false")
    # Wait up to 20 ms for a full queue before a message is dropped.
    queue = "transport/link/tx/queue"
    config.insert_json5(f"{queue}/congestion_control/drop/wait_before_drop", "20000")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise Error(f"no node is at {connect}: start one with `bundlemocap run`, or give its address ({error})") from None


class Stream:
    """Publishes messages that matter only while they are new."""

    def __init__(self, session: zenoh.Session, topic: str) -> None:
        self._publisher = session.declare_publisher(
            topic,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
        )

    def put(self, message: Any, capture_time_ns: int) -> None:
        self._publisher.put(message.SerializeToString(), **_about(message, capture_time_ns))


class State:
    """Publishes messages; late joiners get the last ones."""

    def __init__(self, session: zenoh.Session, topic: str, history: int = 1) -> None:
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session,
            topic,
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(max_samples=history),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def put(self, message: Any, capture_time_ns: int) -> None:
        self._publisher.put(message.SerializeToString(), **_about(message, capture_time_ns))


class Command:
    """Publishes commands, such as Take. Late joiners get no commands, unlike the messages of a `State`."""

    def __init__(self, session: zenoh.Session, topic: str) -> None:
        self._publisher = session.declare_publisher(topic, congestion_control=zenoh.CongestionControl.BLOCK)

    def put(self, message: Any) -> None:
        self._publisher.put(message.SerializeToString(), **_about(message, 0))


def _about(message: Any, capture_time_ns: int) -> dict[str, Any]:
    return {
        "encoding": f"application/protobuf;{message.DESCRIPTOR.full_name}",
        "attachment": struct.pack("<q", capture_time_ns),
    }


class Subscriber:
    """A subscriber, and the token by which others see it."""

    _number = uuid.uuid4().hex[:8]

    def __init__(self, session: zenoh.Session, topic: str, *subscribers: Any) -> None:
        pattern = "/".join("+" * len(part) if set(part) == {"*"} else part for part in topic.split("/"))
        names = pathlib.Path(sys.argv[0]).stem, platform.node(), f"{os.getpid()}.{self._number}"
        about = "/".join(re.sub(r"[/*$?#@\x00-\x1f]", "_", name)[:40] or "unknown" for name in names)
        self._parts: list[Any] = list(subscribers)
        # The subscription does not depend on it.
        with contextlib.suppress(zenoh.ZError):
            self._parts.append(session.liveliness().declare_token(f"mocap/receivers/{about}/{pattern}"))

    def undeclare(self) -> None:
        for part in self._parts:
            part.undeclare()


def subscribe_stream(session: zenoh.Session, topic: str, message_type: Any, handle: Callable[[Any], Any]) -> Subscriber:
    """Calls `handle(message)` for new messages. Keep the returned subscriber."""
    return subscribe_stream_samples(session, topic, _decoding(message_type, handle))


def subscribe_stream_samples(session: zenoh.Session, topic: str, handle: Callable[[zenoh.Sample], Any]) -> Subscriber:
    """Calls `handle(sample)` for new samples of any type. Keep the returned subscriber."""
    return Subscriber(session, topic, session.declare_subscriber(topic, handle))


def subscribe_state(session: zenoh.Session, topic: str, message_type: Any, handle: Callable[[Any], Any]) -> Subscriber:
    """Calls `handle(message)` for the last and for new messages. Keep the returned subscriber."""
    return subscribe_samples(session, topic, _decoding(message_type, handle))


def subscribe_samples(session: zenoh.Session, topic: str, handle: Callable[[zenoh.Sample], Any]) -> Subscriber:
    """Calls `handle(sample)` for the last and for new samples of any type. Keep the subscriber."""
    # A router may stamp the samples of all publishers with its clock. Then zenoh-ext takes them for samples of one source,
    # and drops those that are out of order. So only numbered samples come through its subscriber.
    numbered = zenoh.ext.declare_advanced_subscriber(
        session,
        topic,
        lambda sample: sample.source_info and handle(sample),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
    others = session.declare_subscriber(topic, lambda sample: sample.source_info or handle(sample))
    return Subscriber(session, topic, numbered, others)


def _decoding(message_type: Any, handle: Callable[[Any], Any]) -> Callable[[zenoh.Sample], Any]:
    return lambda sample: handle(message_type.FromString(sample.payload.to_bytes()))


class CameraNode:
    """One camera. `name` is its name in the calibration, `size` the image size in pixels, `format` the keypoint format, a
    key of `bundlemocap.FORMATS`."""

    def __init__(self, session: zenoh.Session, name: str, size: tuple[int, int], format: str, stage: str = "stage") -> None:
        self._name, self.size, self._format, self._frame = name, size, format, 0
        self._stream = Stream(session, f"mocap/{stage}/camera/{name}/keypoints")

    def publish(self, people: Iterable[Iterable[Sequence[float]]], capture_time_ns: int, number: int | None = None) -> None:
        """`people` contains the points of each person in the order of the format: x and y in pixels
        and a confidence, 0 for a missing point. `capture_time_ns` is the middle of the exposure on a
        clock that all cameras share (PTP, or `time.time_ns()` of one computer when the image arrives,
        less exposure and transfer), not the time of detection. A millisecond of error is 0.8 mm at a
        walking hand. The best clock is the node's own: poses are due on it. `number` counts the images,
        also those that were skipped; without it, those that are published."""
        frame = __getattr__("KeypointFrame")(
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


def recorded(path: str | os.PathLike[str]) -> tuple[Any, list[Any]]:
    """The calibration of a recording, or None, and its keypoint frames in order of capture time."""
    rig, frames = None, []
    for topic, _, kind, payload in read_messages(path):
        if "truth" in topic:
            continue
        if kind == f"{_PACKAGE}.Rig":
            rig = decoded(kind, payload)
        elif kind == f"{_PACKAGE}.KeypointFrame":
            frames.append(decoded(kind, payload))
    return rig, sorted(frames, key=lambda frame: frame.capture_time_ns)


def triples(numbers: Sequence[float]) -> list[tuple[float, ...]]:
    """The points of a person, from x, y, confidence, x, y, ... of a message."""
    return list(zip(numbers[0::3], numbers[1::3], numbers[2::3]))
