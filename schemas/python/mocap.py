"""Shared by Python nodes: sessions, publishers and subscribers.

The payload of a zenoh sample is a message of ../*.proto, its encoding names the message, its
attachment is the capture time in nanoseconds: 8 bytes, little endian.
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

import zenoh
import zenoh.ext

sys.path.append(str(pathlib.Path(__file__).resolve().parent / "generated"))


def open_session(connect="tcp/127.0.0.1:7447"):
    """A session as client of the node at this address."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    try:
        config.insert_json5("connect/endpoints", json.dumps([connect]))
    except zenoh.ZError as error:
        raise SystemExit(f"{connect!r} is no address, such as tcp/127.0.0.1:7447 ({error})") from None
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "false")
    # Wait up to 20 ms for a full queue before a message is dropped.
    queue = "transport/link/tx/queue"
    config.insert_json5(f"{queue}/congestion_control/drop/wait_before_drop", "20000")
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SystemExit(f"no node is at {connect}: start one with `bundlemocap run`, or give its address ({error})") from None


class Stream:
    """Publishes messages that matter only while they are new."""

    def __init__(self, session, topic):
        self._publisher = session.declare_publisher(
            topic,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
        )

    def put(self, message, capture_time_ns):
        self._publisher.put(message.SerializeToString(), **_about(message, capture_time_ns))


class State:
    """Publishes messages; late joiners get the last ones."""

    def __init__(self, session, topic, history=1):
        self._publisher = zenoh.ext.declare_advanced_publisher(
            session,
            topic,
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(max_samples=history),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            publisher_detection=True,
        )

    def put(self, message, capture_time_ns):
        self._publisher.put(message.SerializeToString(), **_about(message, capture_time_ns))


class Command:
    """Publishes commands, such as Take. Late joiners get no commands, unlike the messages of a `State`."""

    def __init__(self, session, topic):
        self._publisher = session.declare_publisher(topic, congestion_control=zenoh.CongestionControl.BLOCK)

    def put(self, message):
        self._publisher.put(message.SerializeToString(), **_about(message, 0))


def _about(message, capture_time_ns):
    return {
        "encoding": f"application/protobuf;{message.DESCRIPTOR.full_name}",
        "attachment": struct.pack("<q", capture_time_ns),
    }


class _Announced:
    """A subscriber, and the token by which others see it."""

    _number = uuid.uuid4().hex[:8]

    def __init__(self, session, topic, *subscribers):
        pattern = "/".join("+" * len(part) if set(part) == {"*"} else part for part in topic.split("/"))
        names = pathlib.Path(sys.argv[0]).stem, platform.node(), f"{os.getpid()}.{self._number}"
        about = "/".join(re.sub(r"[/*$?#@\x00-\x1f]", "_", name)[:40] or "unknown" for name in names)
        self._parts = list(subscribers)
        # The subscription does not depend on it.
        with contextlib.suppress(zenoh.ZError):
            self._parts.append(session.liveliness().declare_token(f"mocap/receivers/{about}/{pattern}"))

    def undeclare(self):
        for part in self._parts:
            part.undeclare()


def subscribe_stream(session, topic, message_type, handle):
    """Calls `handle(message)` for new messages. Keep the returned subscriber."""
    return subscribe_stream_samples(session, topic, _decoding(message_type, handle))


def subscribe_stream_samples(session, topic, handle):
    """Calls `handle(sample)` for new samples of any type. Keep the returned subscriber."""
    return _Announced(session, topic, session.declare_subscriber(topic, handle))


def subscribe_state(session, topic, message_type, handle):
    """Calls `handle(message)` for the last and for new messages. Keep the returned subscriber."""
    return subscribe_samples(session, topic, _decoding(message_type, handle))


def subscribe_samples(session, topic, handle):
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
    return _Announced(session, topic, numbered, others)


def _decoding(message_type, handle):
    return lambda sample: handle(message_type.FromString(sample.payload.to_bytes()))
