//! The `bundlemocap` command.

fn main() {}
