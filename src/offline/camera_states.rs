//! The state of the cameras, once a second of the take, as a live node publishes it: programs that show poses.mcap
//! judge the cameras by it.

use crate::core::camera::{Camera, Rig};
use crate::core::detections::Detections;
use crate::core::time::{Nanos, Timestamp};
use crate::core::tracker::{Event, EventKind, Verdict, WindowReport};
use crate::diagnose::{CameraCheck, Check};
use crate::io::wire::{CameraCounters, Status, WindowCounters};
use crate::metrics::{CameraState, set_residuals};

pub(super) struct CameraStates {
    cameras: Vec<CameraState>,
    /// Frames of each that were used.
    used: Vec<u64>,
    /// What is wrong with each, and with all.
    verdicts: Vec<String>,
    verdict: String,
    windows: WindowCounters,
    /// Begin of the current second, capture time.
    since: Option<Timestamp>,
}

impl CameraStates {
    /// `check`: what is wrong with the cameras, if that is known.
    pub(super) fn new(rig: &Rig, check: Option<&Check>) -> Self {
        let cameras: Vec<_> =
            rig.cameras.iter().map(|camera| CameraState::new(&camera.name)).collect();
        let used = vec![0; cameras.len()];
        let judged = |name: &str| check?.cameras.iter().find(|camera| camera.camera == name);
        let verdict = |camera: &Camera| judged(&camera.name).map(CameraCheck::fault);
        let verdicts =
            rig.cameras.iter().map(|camera| verdict(camera).unwrap_or_default()).collect();
        let verdict = check.map(Check::fault).unwrap_or_default();
        Self { cameras, used, verdicts, verdict, windows: WindowCounters::default(), since: None }
    }

    /// Counts a frame. Returns the status of the second before, if it begins another one.
    pub(super) fn frame(&mut self, frame: &Detections) -> Option<Status> {
        let now = frame.capture;
        let passed = now - *self.since.get_or_insert(now);
        let status = (passed >= Nanos::SECOND).then(|| self.second(now, passed));
        let camera = self.cameras.get_mut(frame.camera)?;
        camera.frame(now, frame.frame, now);
        self.used[frame.camera] += 1;
        status
    }

    fn second(&mut self, now: Timestamp, passed: Nanos) -> Status {
        self.since = Some(now);
        self.cameras.iter_mut().for_each(|camera| camera.second(now, passed));
        let all = self.cameras.iter().zip(&self.used).zip(&self.verdicts);
        let counters = |((one, used), verdict): ((&CameraState, &u64), &String)| CameraCounters {
            verdict: verdict.clone(),
            ..one.counters(now, *used, true, (0.0, 0.0))
        };
        Status {
            capture_time_ns: now.ns(),
            cameras: all.map(counters).collect(),
            windows: Some(self.windows.clone()),
            verdict: self.verdict.clone(),
            ..Status::default()
        }
    }

    /// Takes the residuals of a window.
    pub(super) fn window(&mut self, report: &WindowReport) {
        let count = match report.verdict {
            Verdict::Tracked => &mut self.windows.tracked,
            Verdict::Coasted(_) => &mut self.windows.coasted,
            Verdict::Lost(_) => &mut self.windows.lost,
        };
        *count += 1;
        set_residuals(&mut self.cameras, report);
    }

    /// Counts an event of a camera.
    pub(super) fn event(&mut self, event: &Event) {
        let Some(index) = event.camera else { return };
        let Some(camera) = self.cameras.get_mut(index) else { return };
        camera.event(event.kind, event.count);
        let unused =
            [EventKind::Late, EventKind::Abandoned, EventKind::Duplicate, EventKind::Unusable];
        if unused.contains(&event.kind) {
            self.used[index] = self.used[index].saturating_sub(event.count);
        }
    }
}
