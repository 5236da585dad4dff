//! Writes the parts of a BVH file: hierarchy, frames, and at the end their number.

use std::fmt::Write as _;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

use super::read::{Bvh, BvhJoint, Channel};
use crate::io::formats::ExportError;
use crate::io::new_file::NewFile;

/// Width of the number of frames, which is filled in at the end.
const COUNT_DIGITS: usize = 12;

/// A BVH file with a complete hierarchy, ready for frames.
#[derive(Debug)]
pub(super) struct MotionFile {
    file: NewFile,
    frames: usize,
    /// Byte position of the number of frames.
    count_at: u64,
}

impl MotionFile {
    pub(super) fn create(path: &Path, hierarchy: &str, fps: f64) -> Result<Self, ExportError> {
        ExportError::check_rate(path, fps)?;
        let head = format!("{hierarchy}MOTION\nFrames: ");
        let tail = format!("{:>COUNT_DIGITS$}\nFrame Time: {:.9}\n", 0, 1.0 / fps);
        let mut file = NewFile::create(path).map_err(ExportError::write(path))?;
        let written = file.file().write_all((head.clone() + &tail).as_bytes());
        written.map_err(ExportError::write(path))?;
        Ok(Self { file, frames: 0, count_at: head.len() as u64 })
    }

    /// Adds a frame as a line of numbers; `finite` says whether all of them are finite.
    pub(super) fn write(&mut self, line: &str, finite: bool) -> Result<(), ExportError> {
        if !finite {
            let path = self.file.path().into();
            return Err(ExportError::NotFinite { path, frame: self.frames });
        }
        self.frames += 1;
        let written = writeln!(self.file.file(), "{line}");
        written.map_err(ExportError::write(self.file.path()))
    }

    pub(super) fn finish(mut self) -> Result<(), ExportError> {
        let path = self.file.path().to_owned();
        self.count_frames().map_err(ExportError::write(&path))?;
        self.file.finish().map(drop).map_err(ExportError::write(&path))
    }

    fn count_frames(&mut self) -> std::io::Result<()> {
        let file = self.file.file();
        file.seek(SeekFrom::Start(self.count_at))?;
        write!(file, "{:>COUNT_DIGITS$}", self.frames)
    }
}

/// Writes frames on the hierarchy of another BVH file, with its names, offsets, channels, order,
/// unit and axes.
///
/// The file appears at its path when [`HierarchyWriter::finish`] succeeds, and not before.
#[derive(Debug)]
pub struct HierarchyWriter(MotionFile);

impl HierarchyWriter {
    /// Begins a file with the hierarchy of `bvh`.
    ///
    /// # Errors
    /// The folder is not writable, or `fps` is not above 0.
    pub fn create(path: &Path, bvh: &Bvh, fps: f64) -> Result<Self, ExportError> {
        MotionFile::create(path, &hierarchy(bvh.joints()), fps).map(Self)
    }

    /// Adds a frame: the values of all channels, in the order of the hierarchy.
    ///
    /// # Errors
    /// The disk is full, or a value is not finite.
    pub fn write(&mut self, values: &[f64]) -> Result<(), ExportError> {
        let numbers: Vec<String> = values.iter().map(|value| format!("{value:.6}")).collect();
        self.0.write(&numbers.join(" "), values.iter().all(|value| value.is_finite()))
    }

    /// Completes the file and moves it to its path.
    ///
    /// # Errors
    /// The disk is full, or the destination cannot be replaced.
    pub fn finish(self) -> Result<(), ExportError> {
        self.0.finish()
    }
}

/// Parents come before their children; a joint's descendants follow it directly.
fn hierarchy(joints: &[BvhJoint]) -> String {
    let mut text = String::from("HIERARCHY\n");
    let mut open: Vec<usize> = Vec::new();
    for (index, joint) in joints.iter().enumerate() {
        while open.last().copied() != joint.parent {
            close(&mut text, &mut open);
        }
        let tabs = "\t".repeat(open.len());
        let kind = if joint.parent.is_some() { "JOINT" } else { "ROOT" };
        // Writing into a string cannot fail.
        let _ = writeln!(text, "{tabs}{kind} {}\n{tabs}{{", joint.name);
        let _ = writeln!(text, "{tabs}\t{}", offset(&joint.offset));
        let names: String = joint.channels.iter().map(|&channel| name(channel)).collect();
        let _ = writeln!(text, "{tabs}\tCHANNELS {}{names}", joint.channels.len());
        if let Some(end) = &joint.end {
            let _ = writeln!(text, "{tabs}\tEnd Site\n{tabs}\t{{\n{tabs}\t\t{}", offset(end));
            let _ = writeln!(text, "{tabs}\t}}");
        }
        open.push(index);
    }
    while !open.is_empty() {
        close(&mut text, &mut open);
    }
    text
}

fn close(text: &mut String, open: &mut Vec<usize>) {
    open.pop();
    let _ = writeln!(text, "{}}}", "\t".repeat(open.len()));
}

fn offset(at: &nalgebra::Vector3<f64>) -> String {
    format!("OFFSET {} {} {}", at.x, at.y, at.z)
}

fn name(channel: Channel) -> String {
    let (axis, kind) = match channel {
        Channel::Position(axis) => (axis, "position"),
        Channel::Rotation(axis) => (axis, "rotation"),
    };
    format!(" {}{kind}", ["X", "Y", "Z"].get(axis).unwrap_or(&"X"))
}
