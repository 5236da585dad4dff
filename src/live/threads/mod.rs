//! The threads around the core: queues, solvers, playout, and the node that starts and stops them.

mod bodies_folder;
pub(super) mod cpu_affinity;
pub(super) mod node_loop;
pub(super) mod outlet;
pub(super) mod playout;
pub(super) mod presence;
pub(super) mod queue;
pub(super) mod rig_file;
pub(super) mod run;
pub(super) mod solvers;
