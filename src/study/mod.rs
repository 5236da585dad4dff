//! Methods measured against each other: takes in, tables and plots out.
