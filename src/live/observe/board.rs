//! State that the node's threads share: the last status, the rig, and failures.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use crate::io::bus::Sample;
use crate::io::wire::{StageStatus, Status};

/// State that the node's threads share.
#[derive(Default)]
pub(crate) struct Board {
    status: Mutex<Option<Status>>,
    stage: Mutex<Option<StageStatus>>,
    rig: Mutex<Option<Sample>>,
    failures: Arc<AtomicU64>,
}

impl Board {
    /// The last status, if there is one.
    pub(crate) fn status(&self) -> Option<Status> {
        self.status.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stores a new status.
    pub(crate) fn set_status(&self, status: Status) {
        *self.status.lock().unwrap_or_else(PoisonError::into_inner) = Some(status);
    }

    /// Who is there, if that is known.
    pub(crate) fn stage(&self) -> Option<StageStatus> {
        self.stage.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stores who is there.
    pub(crate) fn set_stage(&self, stage: StageStatus) {
        *self.stage.lock().unwrap_or_else(PoisonError::into_inner) = Some(stage);
    }

    /// The current rig, if there is one.
    pub(crate) fn rig(&self) -> Option<Sample> {
        self.rig.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stores a new rig.
    pub(crate) fn set_rig(&self, rig: Sample) {
        *self.rig.lock().unwrap_or_else(PoisonError::into_inner) = Some(rig);
    }

    /// The counter of messages that could not be published.
    pub(crate) fn failures(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.failures)
    }

    /// Number of messages that could not be published.
    pub(crate) fn publish_failures(&self) -> u64 {
        self.failures.load(Ordering::Relaxed)
    }
}
