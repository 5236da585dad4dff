//! Recordings: MCAP files in and out.
