//! Reads BVH files: hierarchy and motion, in the file's unit and axes.
//!
//! A joint's local rotation is the product of its channels' rotations in the order in which the
//! file lists them. Position channels replace the joint's offset on their axes.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// Why a text is not a valid BVH file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs)]
pub enum BvhError {
    #[error("it is not a text in UTF-8, as BVH files are")]
    Encoding,
    #[error("line {line}: `{found}` instead of {expected}; the file is not valid BVH")]
    Unexpected { line: usize, expected: &'static str, found: String },
    #[error("the file ends before {expected}; it is incomplete")]
    Ends { expected: &'static str },
    #[error(
        "line {line}: the frame has {found} values but the hierarchy has {expected} channels; \
         the line is cut short or belongs to another skeleton"
    )]
    FrameLength { line: usize, found: usize, expected: usize },
    #[error("{found} frames follow where `Frames:` says {declared}; the file is incomplete")]
    FrameCount { found: usize, declared: usize },
}

/// Meaning of one number of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Position along axis 0, 1 or 2, in the file's unit.
    Position(usize),
    /// Rotation about axis 0, 1 or 2, in degrees.
    Rotation(usize),
}

/// A joint of the file's hierarchy.
#[derive(Clone, Debug, PartialEq)]
pub struct BvhJoint {
    /// Name in the file.
    pub name: String,
    /// Index of the parent, which comes earlier in the file; `None` for the root.
    pub parent: Option<usize>,
    /// Offset from the parent at zero rotation, in the file's unit.
    pub offset: Vector3<f64>,
    /// Channels in the order of multiplication.
    pub channels: Vec<Channel>,
    /// Offset of the end site, if the joint has one.
    pub end: Option<Vector3<f64>>,
    first_value: usize,
}

/// A BVH file.
#[derive(Clone, Debug, PartialEq)]
pub struct Bvh {
    joints: Vec<BvhJoint>,
    frame_time: f64,
    values: Vec<f64>,
    channels: usize,
    frames: usize,
}

impl Bvh {
    /// Parses the text of a file with one root.
    ///
    /// # Errors
    /// The text is not BVH or is incomplete, or a frame has not one value for each channel.
    pub fn parse(text: &str) -> Result<Self, BvhError> {
        let mut lines = Lines::new(text);
        let bvh = Self::without_frames(hierarchy(&mut lines)?);
        lines.keyword("MOTION", "`MOTION`")?;
        lines.keyword("Frames:", "`Frames:`")?;
        let frames: usize = lines.number("the number of frames")?;
        lines.keyword("Frame", "`Frame Time:`")?;
        lines.keyword("Time:", "`Frame Time:`")?;
        let frame_time = lines.float("the frame time in seconds, above 0")?;
        if frame_time <= 0.0 {
            return Err(lines.wrong("the frame time in seconds, above 0", "0 or less"));
        }
        let values = motion(&mut lines, bvh.channels, frames)?;
        Ok(Self { frame_time, values, frames, ..bvh })
    }

    /// Parses the hierarchy alone; the result has no frames.
    ///
    /// # Errors
    /// As [`Bvh::parse`], but the motion may be missing or wrong.
    pub fn parse_hierarchy(text: &str) -> Result<Self, BvhError> {
        hierarchy(&mut Lines::new(text)).map(Self::without_frames)
    }

    fn without_frames(joints: Vec<BvhJoint>) -> Self {
        let channels = joints.iter().map(|joint| joint.channels.len()).sum();
        Self { joints, frame_time: 0.0, values: Vec::new(), channels, frames: 0 }
    }

    /// Joints, parents before children.
    pub fn joints(&self) -> &[BvhJoint] {
        &self.joints
    }

    /// Index of the joint with that name.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.frames
    }

    /// Frame period, seconds; 0 after [`Bvh::parse_hierarchy`].
    pub fn frame_time(&self) -> f64 {
        self.frame_time
    }

    /// Rotation `parent_from_joint`, and position in the parent's frame. `None` if the file does
    /// not have the frame or joint.
    pub fn local(&self, frame: usize, joint: usize) -> Option<(Matrix3<f64>, Vector3<f64>)> {
        let joint = self.joints.get(joint)?;
        let first = frame.checked_mul(self.channels)? + joint.first_value;
        let values = self.values.get(first..first + joint.channels.len())?;
        if frame >= self.frames {
            return None;
        }
        let (mut rotation, mut position) = (Rotation3::identity(), joint.offset);
        for (channel, value) in joint.channels.iter().zip(values) {
            match *channel {
                Channel::Position(axis) => position[axis] = *value,
                Channel::Rotation(axis) => {
                    let axis = Vector3::ith_axis(axis);
                    rotation *= Rotation3::from_axis_angle(&axis, value.to_radians());
                }
            }
        }
        Some((rotation.into_inner(), position))
    }

    /// Rotation `world_from_joint` and position of every joint, in the file's world and unit.
    /// `None` if the file does not have the frame.
    pub fn posture(&self, frame: usize) -> Option<Vec<(Matrix3<f64>, Vector3<f64>)>> {
        let mut posture: Vec<(Matrix3<f64>, Vector3<f64>)> = Vec::with_capacity(self.joints.len());
        for (index, joint) in self.joints.iter().enumerate() {
            let (rotation, position) = self.local(frame, index)?;
            posture.push(match joint.parent {
                None => (rotation, position),
                Some(parent) => {
                    let (turn, origin) = posture[parent];
                    (turn * rotation, origin + turn * position)
                }
            });
        }
        Some(posture)
    }
}

/// The words of a text with their line numbers.
struct Lines<'a> {
    rest: std::iter::Peekable<std::iter::Enumerate<std::str::Lines<'a>>>,
    words: std::str::SplitWhitespace<'a>,
    line: usize,
}

impl<'a> Lines<'a> {
    fn new(text: &'a str) -> Self {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        Self { rest: text.lines().enumerate().peekable(), words: "".split_whitespace(), line: 0 }
    }

    /// The next word; `None` at the end of the text.
    fn word(&mut self) -> Option<&'a str> {
        loop {
            if let Some(word) = self.words.next() {
                return Some(word);
            }
            self.words = self.line()?.split_whitespace();
        }
    }

    /// The next word of this line, if it is not that one.
    fn word_of_line_before(&mut self, end: &str) -> Option<&'a str> {
        let mut words = self.words.clone();
        let word = words.next().filter(|word| *word != end)?;
        self.words = words;
        Some(word)
    }

    /// The next whole line.
    fn line(&mut self) -> Option<&'a str> {
        let (index, line) = self.rest.next()?;
        self.line = index + 1;
        Some(line)
    }

    fn expect(&mut self, expected: &'static str) -> Result<&'a str, BvhError> {
        self.word().ok_or(BvhError::Ends { expected })
    }

    fn wrong(&self, expected: &'static str, found: &str) -> BvhError {
        let found = found.chars().take(40).collect();
        BvhError::Unexpected { line: self.line, expected, found }
    }

    fn keyword(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        let word = self.expect(expected)?;
        if word == keyword { Ok(()) } else { Err(self.wrong(expected, word)) }
    }

    fn number<N: std::str::FromStr>(&mut self, expected: &'static str) -> Result<N, BvhError> {
        let word = self.expect(expected)?;
        word.parse().map_err(|_| self.wrong(expected, word))
    }

    fn float(&mut self, expected: &'static str) -> Result<f64, BvhError> {
        let word = self.expect(expected)?;
        word.parse()
            .ok()
            .filter(|value: &f64| value.is_finite())
            .ok_or_else(|| self.wrong(expected, word))
    }

    fn vector(&mut self, expected: &'static str) -> Result<Vector3<f64>, BvhError> {
        Ok(Vector3::new(self.float(expected)?, self.float(expected)?, self.float(expected)?))
    }
}

/// Reads the joints from `HIERARCHY` to the closing brace of the root.
fn hierarchy(lines: &mut Lines) -> Result<Vec<BvhJoint>, BvhError> {
    lines.keyword("HIERARCHY", "`HIERARCHY`")?;
    lines.keyword("ROOT", "`ROOT`")?;
    let mut values = 0;
    let mut joints = vec![open_joint(lines, None, &mut values)?];
    let mut open = vec![0];
    while let Some(&parent) = open.last() {
        match lines.expect("`JOINT`, `End Site` or `}`")? {
            "JOINT" => {
                open.push(joints.len());
                joints.push(open_joint(lines, Some(parent), &mut values)?);
            }
            "End" => joints[parent].end = Some(end_site(lines)?),
            "}" => {
                open.pop();
            }
            other => return Err(lines.wrong("`JOINT`, `End Site` or `}`", other)),
        }
    }
    Ok(joints)
}

/// Reads a joint's name, offset and channels; its brace stays open.
fn open_joint(
    lines: &mut Lines,
    parent: Option<usize>,
    values: &mut usize,
) -> Result<BvhJoint, BvhError> {
    let mut name = lines.expect("a joint's name")?.to_owned();
    // Names of 3ds Max have blanks.
    while let Some(word) = lines.word_of_line_before("{") {
        name = format!("{name} {word}");
    }
    lines.keyword("{", "`{`")?;
    lines.keyword("OFFSET", "`OFFSET`")?;
    let offset = lines.vector("an offset of three numbers")?;
    lines.keyword("CHANNELS", "`CHANNELS`")?;
    let count: usize = lines.number("the number of channels, 0 to 6")?;
    if count > 6 {
        return Err(lines.wrong("the number of channels, 0 to 6", &count.to_string()));
    }
    let channels = (0..count).map(|_| channel(lines)).collect::<Result<Vec<_>, _>>()?;
    let first_value = *values;
    *values += count;
    Ok(BvhJoint { name, parent, offset, channels, end: None, first_value })
}

fn channel(lines: &mut Lines) -> Result<Channel, BvhError> {
    let expected = "a channel such as `Xposition` or `Zrotation`";
    let word = lines.expect(expected)?;
    Ok(match word {
        "Xposition" => Channel::Position(0),
        "Yposition" => Channel::Position(1),
        "Zposition" => Channel::Position(2),
        "Xrotation" => Channel::Rotation(0),
        "Yrotation" => Channel::Rotation(1),
        "Zrotation" => Channel::Rotation(2),
        other => return Err(lines.wrong(expected, other)),
    })
}

fn end_site(lines: &mut Lines) -> Result<Vector3<f64>, BvhError> {
    lines.keyword("Site", "`End Site`")?;
    lines.keyword("{", "`{`")?;
    lines.keyword("OFFSET", "`OFFSET`")?;
    let offset = lines.vector("an offset of three numbers")?;
    lines.keyword("}", "`}`")?;
    Ok(offset)
}

/// Reads all values, one line per frame.
fn motion(lines: &mut Lines, channels: usize, declared: usize) -> Result<Vec<f64>, BvhError> {
    let mut values = Vec::new();
    let mut found = 0;
    while found < declared {
        let Some(line) = lines.line() else {
            return Err(BvhError::FrameCount { found, declared });
        };
        if line.trim().is_empty() {
            continue;
        }
        let before = values.len();
        for word in line.split_whitespace() {
            let value = word.parse().ok().filter(|value: &f64| value.is_finite());
            values.push(value.ok_or_else(|| lines.wrong("a finite number", word))?);
        }
        if values.len() - before != channels {
            let found = values.len() - before;
            return Err(BvhError::FrameLength { line: lines.line, found, expected: channels });
        }
        found += 1;
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO_JOINTS: &str = "HIERARCHY\nROOT a\n{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition \
        Zposition Zrotation Yrotation Xrotation\n JOINT b\n {\n  OFFSET 0 1 0\n  CHANNELS 3 \
        Zrotation Xrotation Yrotation\n  End Site\n  {\n   OFFSET 1 0 0\n  }\n }\n}\nMOTION\n\
        Frames: 2\nFrame Time: 0.0166667\n1 2 3 90 0 0 0 0 0\n1 2 3 0 0 0 90 0 90\n";

    #[test]
    fn channels_multiply_in_their_order() {
        let bvh = Bvh::parse(TWO_JOINTS).unwrap();
        assert_eq!((bvh.frames(), bvh.joints().len(), bvh.joint("b")), (2, 2, Some(1)));
        let (_, position) = bvh.posture(0).unwrap()[1];
        assert!((position - Vector3::new(0.0, 2.0, 3.0)).norm() < 1e-12);
        let (rotation, _) = bvh.posture(1).unwrap()[1];
        let expected = Rotation3::from_axis_angle(&Vector3::z_axis(), 90f64.to_radians())
            * Rotation3::from_axis_angle(&Vector3::y_axis(), 90f64.to_radians());
        assert!((rotation - expected.into_inner()).amax() < 1e-12);
        assert!(bvh.posture(2).is_none() && bvh.local(0, 2).is_none());
    }

    #[test]
    fn names_may_have_blanks() {
        for names in ["JOINT Bip01 L Thigh", "JOINT  Bip01 L\tThigh  "] {
            let bvh = Bvh::parse(&TWO_JOINTS.replace("JOINT b", names)).unwrap();
            assert_eq!(bvh.joint("Bip01 L Thigh"), Some(1));
        }
        let bvh = Bvh::parse(&TWO_JOINTS.replace("JOINT b\n {", "JOINT b {")).unwrap();
        assert_eq!(bvh.joint("b"), Some(1));
    }

    #[test]
    fn what_is_wrong_is_said_with_its_line() {
        let message = |text: &str| Bvh::parse(text).unwrap_err().to_string();
        let broken = |from: &str, to: &str| message(&TWO_JOINTS.replacen(from, to, 1));
        assert!(broken("Zrotation", "Wrotation").starts_with("line 5: `Wrotation`"));
        assert!(broken("OFFSET 0 1 0", "OFFSET 0 nan 0").starts_with("line 8: `nan`"));
        assert!(broken("1 2 3 90 0", "1 2 3 90").starts_with("line 19: the frame has 8 values"));
        assert!(broken("Frames: 2", "Frames: 3").starts_with("2 frames follow"));
        assert!(broken("0.0166667", "0").contains("above 0"));
        assert!(message("").starts_with("the file ends"));
        assert!(message("HIERARCHY\nROOT a\n{").contains("`OFFSET`"));
    }

    #[test]
    fn no_prefix_of_a_file_panics() {
        for end in 0..TWO_JOINTS.len() - 1 {
            let _ = Bvh::parse(&TWO_JOINTS[..end]);
        }
    }
}
