"""What Python nodes share: a session, topics, and samples with their capture time.

A sample is a zenoh sample whose payload is a message of ../*.proto, whose encoding names the
message, and whose attachment is the capture time: 8 bytes, little endian, nanoseconds.
"""

import pathlib
import struct
import sys

import zenoh
import zenoh.ext

sys.path.append(str(pathlib.Path(__file__).resolve().parent / "generated"))


def open_session(connect="tcp/127.0.0.1:7447"):
    """A client of the node at this address."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{connect}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "false")
    # On a busy machine a full queue is waited for up to 20 ms before a message is dropped.
    queue = "transport/link/tx/queue"
    config.insert_json5(f"{queue}/congestion_control/drop/wait_before_drop", "20000")
    return zenoh.open(config)


class Stream:
    """Publishes messages that are of use only while they are new."""

    def __init__(self, session, topic):
        self._publisher = session.declare_publisher(
            topic,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )

    def put(self, message, capture_time_ns):
        self._publisher.put(message.SerializeToString(), **_about(message, capture_time_ns))


class State:
    """Publishes messages of which late joiners get the last ones."""

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


def _about(message, capture_time_ns):
    return {
        "encoding": f"application/protobuf;{message.DESCRIPTOR.full_name}",
        "attachment": struct.pack("<q", capture_time_ns),
    }


def subscribe_stream(session, topic, message_type, handle):
    """Calls `handle(message)` for what is new. Keep what it returns."""
    return session.declare_subscriber(topic, _decoding(message_type, handle))


def subscribe_state(session, topic, message_type, handle):
    """Calls `handle(message)` for the last messages and for what is new. Keep what it returns."""
    return zenoh.ext.declare_advanced_subscriber(
        session,
        topic,
        _decoding(message_type, handle),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )


def _decoding(message_type, handle):
    return lambda sample: handle(message_type.FromString(sample.payload.to_bytes()))
