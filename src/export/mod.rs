//! Poses for other tools, and the report.
