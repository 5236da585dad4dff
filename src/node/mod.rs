//! The live node: messages in, poses at a fixed latency out.
