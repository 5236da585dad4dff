//! What calibration files do not say, or say in several ways: the axis that points up, the unit of length,
//! and whether a pose is of the world in the camera or of the camera in the world.

use std::fmt;
use std::str::FromStr;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use super::Calibrated;
use crate::core::so3;

/// An axis of the calibration's world, the one that points up. In our world it is y.
///
/// A world with z up is converted by x = y', y = z', z = x' (a cyclic permutation, which keeps the
/// ground plane and the handedness). These are the axes that Pose2Sim writes to TRC files. A world
/// with x up is converted by y = x', z = y', x = z'. An axis that points down is turned up by half a
/// turn about the next axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Up {
    /// x up.
    X,
    /// Same axes as our world.
    Y,
    /// z up, as in Qualisys and Pose2Sim.
    #[default]
    Z,
    /// x down.
    MinusX,
    /// y down, as in the first camera's own axes and in Panoptic Studio.
    MinusY,
    /// z down.
    MinusZ,
}

impl Up {
    /// All axes and their names.
    const NAMES: [(Self, &str); 6] = [
        (Self::X, "x"),
        (Self::Y, "y"),
        (Self::Z, "z"),
        (Self::MinusX, "-x"),
        (Self::MinusY, "-y"),
        (Self::MinusZ, "-z"),
    ];

    /// The rotation from our coordinates to the calibration's.
    pub fn calibration_from_world(self) -> Matrix3<f64> {
        let half_turn = |fixed: usize| {
            let sign = |axis: usize| if axis == fixed { 1.0 } else { -1.0 };
            Matrix3::from_diagonal(&Vector3::new(sign(0), sign(1), sign(2)))
        };
        match self {
            Self::X => so3::Z_UP.transpose(),
            Self::Y => Matrix3::identity(),
            Self::Z => so3::Z_UP,
            Self::MinusX => half_turn(1) * so3::Z_UP.transpose(),
            Self::MinusY => half_turn(2),
            Self::MinusZ => half_turn(0) * so3::Z_UP,
        }
    }

    /// The axis nearest to a direction of the calibration's world; `None` if that is between axes.
    pub fn along(direction: &Vector3<f64>) -> Option<Self> {
        let axis = direction.iamax();
        let is_clear = direction[axis].abs() > MIN_ALONG * direction.norm();
        let signed = [[Self::MinusX, Self::X], [Self::MinusY, Self::Y], [Self::MinusZ, Self::Z]];
        is_clear.then(|| signed[axis][usize::from(direction[axis] > 0.0)])
    }

    /// The axis that is up for the cameras, if one clearly is. People seldom turn cameras over. Where they do, under a
    /// ceiling, the cameras look down.
    fn of(cameras: &[Calibrated]) -> Option<Self> {
        let mean = |row: usize| {
            let backwards = |camera: &Calibrated| -camera.rotation.row(row).transpose();
            cameras.iter().map(backwards).sum::<Vector3<f64>>() / cameras.len().max(1) as f64
        };
        let [up, back] =
            [mean(1), mean(2)].map(|mean| Self::along(&mean).filter(|_| mean.norm() > MIN_UPRIGHT));
        up.or(back)
    }
}

impl fmt::Display for Up {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::NAMES.iter().find(|(up, _)| up == self);
        to.write_str(name.map_or("", |(_, name)| name))
    }
}

impl FromStr for Up {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::NAMES.iter().find(|(_, own)| *own == name);
        found.map(|(up, _)| *up).ok_or_else(|| "use x, y, z, -x, -y or -z".to_owned())
    }
}

/// Length of a calibration's unit, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unit(f64);

impl Unit {
    /// A metre.
    pub const M: Self = Self(1.0);
    /// A centimetre.
    pub const CM: Self = Self(1e-2);
    /// A millimetre.
    pub const MM: Self = Self(1e-3);
    /// An inch.
    pub const IN: Self = Self(0.0254);
    /// A foot.
    pub const FT: Self = Self(0.3048);

    /// Its length in metres.
    pub fn metres(self) -> f64 {
        self.0
    }

    /// A unit of so many metres.
    pub fn of_metres(metres: f64) -> Self {
        Self(metres)
    }

    /// The unit in which cameras at this distance from what they look at are in a room.
    fn of(distance: f64) -> Self {
        match distance {
            ..100.0 => Self::M,
            ..500.0 => Self::CM,
            _ => Self::MM,
        }
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::M => to.write_str("m"),
            Self::CM => to.write_str("cm"),
            Self::MM => to.write_str("mm"),
            Self::IN => to.write_str("in"),
            Self::FT => to.write_str("ft"),
            Self(metres) => write!(to, "{metres}"),
        }
    }
}

impl FromStr for Unit {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "m" => Ok(Self::M),
            "cm" => Ok(Self::CM),
            "mm" => Ok(Self::MM),
            "in" => Ok(Self::IN),
            "ft" => Ok(Self::FT),
            other => match other.parse() {
                Ok(metres) if metres > 0.0 && f64::is_finite(metres) => Ok(Self(metres)),
                _ => Err("use m, cm, mm, in, ft, or its length in metres".to_owned()),
            },
        }
    }
}

/// The direction of the poses of a calibration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Poses {
    /// They take the world to the camera, as in OpenCV.
    #[default]
    CameraFromWorld,
    /// They take the camera to the world.
    WorldFromCamera,
}

impl Poses {
    /// The other ones.
    pub fn inverse(self) -> Self {
        match self {
            Self::CameraFromWorld => Self::WorldFromCamera,
            Self::WorldFromCamera => Self::CameraFromWorld,
        }
    }
}

impl fmt::Display for Poses {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.write_str(match self {
            Self::CameraFromWorld => "camera-from-world",
            Self::WorldFromCamera => "world-from-camera",
        })
    }
}

impl FromStr for Poses {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let all = [Self::CameraFromWorld, Self::WorldFromCamera];
        let found = all.into_iter().find(|one| one.to_string() == name);
        found.ok_or_else(|| "use camera-from-world or world-from-camera".to_owned())
    }
}

/// A value that is given, or `auto`: to be found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Auto<T>(pub Option<T>);

impl<T> Default for Auto<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: fmt::Display> fmt::Display for Auto<T> {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Some(value) => value.fmt(to),
            None => to.write_str("auto"),
        }
    }
}

impl<T: FromStr<Err = String>> FromStr for Auto<T> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self(None)),
            text => text.parse().map(|value| Self(Some(value))).map_err(|what| what + ", or auto"),
        }
    }
}

impl<T: fmt::Display> Serialize for Auto<T> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

impl<'a, T: FromStr<Err = String>> Deserialize<'a> for Auto<T> {
    fn deserialize<D: Deserializer<'a>>(from: D) -> Result<Self, D::Error> {
        String::deserialize(from)?.parse().map_err(de::Error::custom)
    }
}

/// What is known of a calibration beside its file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Convention {
    /// The axis that points up.
    pub up: Auto<Up>,
    /// The unit of length.
    pub unit: Auto<Unit>,
    /// What the poses are.
    pub poses: Auto<Poses>,
    /// Of several poses of the cameras in the file, those under this name, such as a subject's.
    pub set: Option<String>,
    /// Whether the unit and axis that a file of ours says come before the given ones.
    pub file_first: bool,
}

impl From<Up> for Convention {
    fn from(up: Up) -> Self {
        Self { up: Auto(Some(up)), ..Self::default() }
    }
}

/// The mean of the cameras' unit vectors, those up in the images or those backwards, tells the up axis if it is longer.
const MIN_UPRIGHT: f64 = 0.5;
/// Share of that mean that must be along one axis: 37 degrees off it, at most.
const MIN_ALONG: f64 = 0.8;
/// Cameras at such distances from what they look at are in no room and on no stage, metres.
const ROOM: std::ops::Range<f64> = 0.7..100.0;
/// Below this mean square of the sines between them, optical axes are parallel.
const MIN_SIN_SQUARED: f64 = 0.1;
/// Mean of the cameras' unit vectors that point up in their images: longer, they are rolled alike.
const MIN_ALIKE: f64 = 0.8;
/// Weight of the cameras' middle where their axes meet: axes that are parallel or opposite meet between them.
const MIDDLE: f64 = 1e-3;

/// camera_from_world by what the file holds: rotation and translation.
type Reading = fn(&Matrix3<f64>, &Vector3<f64>) -> (Matrix3<f64>, Vector3<f64>);

/// Ways to misread a pose, and what the file then holds.
const READINGS: [(&str, Reading); 5] = [
    ("the poses of the cameras in the world", |r, t| (r.transpose(), -(r.transpose() * t))),
    ("transposed rotations", |r, t| (r.transpose(), *t)),
    ("transposed rotations about the right places", |r, t| {
        (r.transpose(), r.transpose() * r.transpose() * t)
    }),
    ("cameras that look along -z, with y up", |r, t| (opengl() * r, opengl() * t)),
    ("the poses in the world of cameras that look along -z, with y up", |r, t| {
        (opengl() * r.transpose(), -(opengl() * r.transpose() * t))
    }),
];

/// OpenCV's axes of a camera from OpenGL's.
pub(super) fn opengl() -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0))
}

/// The note on a calibration whose up axis is guessed.
pub const UP_IS_GUESSED: &str = "the up axis cannot be found from the images; z is used (--up)";

/// What was found out about a calibration.
pub(super) struct Found {
    pub up: Up,
    /// Whether nothing says that this axis points up.
    pub up_is_guessed: bool,
    pub poses: Poses,
    pub unit: Unit,
    pub notes: Vec<String>,
}

/// Brings the cameras to metres and to OpenCV's poses, and finds the axis that points up.
/// `unit`: the one that the format prescribes. A format that does so prescribes the poses too.
pub(super) fn settle(cameras: &mut [Calibrated], unit: Option<Unit>, given: &Convention) -> Found {
    let mut notes = Vec::new();
    let other = match given.poses.0 {
        Some(Poses::CameraFromWorld) => None,
        Some(Poses::WorldFromCamera) => Some(READINGS[0]),
        None => misread(cameras).filter(|_| unit.is_none()),
    };
    if let Some((what, reading)) = other {
        for camera in cameras.iter_mut() {
            (camera.rotation, camera.translation) = reading(&camera.rotation, &camera.translation);
        }
        if given.poses.0.is_none() {
            notes.push(format!(
                "the file is read as {what}: only then all cameras look at one place; \
                 `bundlemocap check` tests this with detections (--poses)"
            ));
        }
    }
    let is_inverse = other.is_some_and(|(what, _)| what == READINGS[0].0);
    let poses = if is_inverse { Poses::WorldFromCamera } else { Poses::CameraFromWorld };
    let distance = distance(cameras);
    let unit = given.unit.0.or(unit).unwrap_or_else(|| distance.map_or(Unit::M, Unit::of));
    for camera in cameras.iter_mut() {
        camera.translation *= unit.metres();
    }
    if let Some(metres) = distance.map(|distance| distance * unit.metres())
        && !ROOM.contains(&metres)
    {
        notes.push(format!(
            "the cameras are {metres:.3} m from what they look at, if the unit is {} m; is the unit right? (--unit)",
            unit.metres()
        ));
    }
    let found = given.up.0.or_else(|| Up::of(cameras));
    let (up, up_is_guessed) = (found.unwrap_or(Up::Z), found.is_none());
    if up_is_guessed {
        notes.push(UP_IS_GUESSED.to_owned());
    }
    if given.up.0.is_none() && lies_on_its_side(cameras, up) {
        let text = "the cameras differ most in height";
        notes.push(format!("{text}; is {up} really the up axis? (--up)"));
    }
    Found { up, up_is_guessed, poses, unit, notes }
}

/// Whether the cameras differ more in height than in any direction over the floor.
fn lies_on_its_side(cameras: &[Calibrated], up: Up) -> bool {
    let world = up.calibration_from_world().transpose();
    let centres: Vec<Vector3<f64>> = (cameras.iter())
        .map(|camera| -(world * camera.rotation.transpose() * camera.translation))
        .collect();
    let spread = |axis: usize| {
        let all = || centres.iter().map(|centre| centre[axis]);
        all().fold(f64::MIN, f64::max) - all().fold(f64::MAX, f64::min)
    };
    spread(1) > spread(0).max(spread(2))
}

/// How the poses must be read so that all cameras look at one place, if they do not as they are.
fn misread(cameras: &[Calibrated]) -> Option<(&'static str, Reading)> {
    let read = |reading: Reading| -> Vec<_> {
        cameras.iter().map(|camera| reading(&camera.rotation, &camera.translation)).collect()
    };
    let seeing = |reading: Reading| {
        let poses = read(reading);
        match meeting_point(&poses) {
            (centre, false) => seeing(cameras, &poses, &centre),
            (_, true) => 0,
        }
    };
    let own = read(|r, t| (*r, *t));
    let up = own.iter().map(|(r, _)| r.row(1).transpose()).sum::<Vector3<f64>>();
    // Cameras beside each other, as in a stereo pair.
    let are_beside = meeting_point(&own).1 && up.norm() > MIN_ALIKE * cameras.len() as f64;
    if are_beside || 2 * seeing(|r, t| (*r, *t)) > cameras.len() {
        return None;
    }
    READINGS.into_iter().find(|(_, reading)| seeing(*reading) == cameras.len())
}

/// Median distance of the cameras from where they look, in the file's unit.
fn distance(cameras: &[Calibrated]) -> Option<f64> {
    let poses: Vec<_> = cameras.iter().map(|one| (one.rotation, one.translation)).collect();
    let (centre, _) = meeting_point(&poses);
    let mut all: Vec<f64> = poses.iter().map(|(r, t)| (r * centre + t).norm()).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().filter(|distance| distance.is_finite())
}

/// The point nearest to all optical axes (least squares), and whether they are parallel or opposite; then it is
/// in the middle between the cameras.
fn meeting_point(poses: &[(Matrix3<f64>, Vector3<f64>)]) -> (Vector3<f64>, bool) {
    let count = poses.len() as f64;
    let centre = |(r, t): &(Matrix3<f64>, Vector3<f64>)| -(r.transpose() * t);
    let middle = poses.iter().map(centre).sum::<Vector3<f64>>() / count;
    let (mut across, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for pose in poses {
        let axis = pose.0.row(2).transpose();
        let off = Matrix3::identity() - axis * axis.transpose();
        across += off / count;
        right += off * (centre(pose) - middle) / count;
    }
    let is_parallel = across.symmetric_eigenvalues().min() < MIN_SIN_SQUARED;
    let held = across + Matrix3::identity() * MIDDLE;
    let point = held.try_inverse().map_or(middle, |inverse| middle + inverse * right);
    (point, is_parallel)
}

/// How many cameras have the point in front of them and in their image.
fn seeing(
    cameras: &[Calibrated],
    poses: &[(Matrix3<f64>, Vector3<f64>)],
    point: &Vector3<f64>,
) -> usize {
    let sees = |(camera, (r, t)): &(&Calibrated, &(Matrix3<f64>, Vector3<f64>))| {
        let at = r * point + t;
        let pixel = camera.matrix * at / at.z;
        let [width, height] = camera.size();
        at.z > 0.0 && (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y)
    };
    cameras.iter().zip(poses).filter(sees).count()
}
