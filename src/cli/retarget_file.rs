//! The BVH file of retargeted poses, written while they come.

use std::path::{Path, PathBuf};

use super::failure::Failure;
use crate::core::time::Timestamp;
use crate::io::formats::bvh::HierarchyWriter;
use crate::offline::bvh::Fill;
use crate::offline::poses::rate;
use crate::retarget::{Channels, Figure, Retarget};

/// Number of poses from which a live file's frame rate is taken.
const FIRST: usize = 120;

/// A file that appears at its path when it is complete.
pub(super) struct TargetFile {
    path: PathBuf,
    fps: Option<f64>,
    start: Timestamp,
    /// Poses before the frame rate is known.
    waiting: Vec<(Timestamp, Vec<f64>)>,
    open: Option<(HierarchyWriter, Fill)>,
    channels: Channels,
    last: Option<(Timestamp, Vec<f64>)>,
    frames: usize,
}

/// A complete file.
pub(super) struct Written {
    pub(super) frames: usize,
    pub(super) fps: f64,
    pub(super) note: Option<String>,
}

impl TargetFile {
    /// A file that begins at `start`, of that frame rate, or else of that of its first poses.
    pub(super) fn new(path: &Path, fps: Option<f64>, start: Timestamp) -> Self {
        Self {
            path: path.to_owned(),
            fps,
            start,
            waiting: Vec::new(),
            open: None,
            channels: Channels::default(),
            last: None,
            frames: 0,
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Adds a pose; skips it if it was captured before the last one. Gaps repeat the pose before, or the first one.
    pub(super) fn add(
        &mut self,
        capture: Timestamp,
        figure: &Figure,
        retarget: &Retarget,
    ) -> Result<(), Failure> {
        let newest = self.waiting.last().or(self.last.as_ref());
        if newest.is_some_and(|(last, _)| capture <= *last) {
            return Ok(());
        }
        self.waiting.push((capture, self.channels.values(retarget, figure)));
        let is_known = self.open.is_some() || self.fps.is_some() || self.waiting.len() >= FIRST;
        if is_known { self.write(retarget) } else { Ok(()) }
    }

    /// Writes the waiting poses.
    fn write(&mut self, retarget: &Retarget) -> Result<(), Failure> {
        let (writer, fill) = match &mut self.open {
            Some(open) => open,
            None => {
                let captures: Vec<Timestamp> = self.waiting.iter().map(|(at, _)| *at).collect();
                let fps = *self.fps.get_or_insert(rate(&captures));
                let writer = HierarchyWriter::create(&self.path, retarget.target().bvh(), fps)?;
                self.open.insert((writer, Fill::new(fps).from(self.start)))
            }
        };
        for (capture, values) in self.waiting.drain(..) {
            let Some(gap) = fill.gap_before(capture) else { continue };
            for _ in 0..gap {
                writer.write(self.last.as_ref().map_or(&values, |(_, values)| values))?;
            }
            writer.write(&values)?;
            self.last = Some((capture, values));
            self.frames += gap + 1;
        }
        Ok(())
    }

    /// Completes the file; `None` if there were no poses.
    pub(super) fn finish(mut self, retarget: &Retarget) -> Result<Option<Written>, Failure> {
        if !self.waiting.is_empty() {
            self.write(retarget)?;
        }
        let (Some((writer, fill)), Some(fps)) = (self.open, self.fps) else { return Ok(None) };
        writer.finish()?;
        Ok(Some(Written { frames: self.frames, fps, note: fill.note(&self.path) }))
    }
}
