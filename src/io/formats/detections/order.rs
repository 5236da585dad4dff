//! The order of a detector's points, and the format in which they are recorded.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Deserialize;

use crate::core::detections::{Detection, Keypoint, KeypointFormat};
use crate::io::formats::point_names::keypoint_of;
use crate::io::formats::{ImportError, unknown_format};

use Keypoint as K;

/// The order of a detector's points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointOrder {
    /// Its name, or the mapping's file.
    pub name: String,
    /// The format in which the points are recorded.
    pub format: KeypointFormat,
    /// Number of points; `None` if others may follow them.
    len: Option<usize>,
    /// The detector's index of each point of the format.
    index: Vec<Option<usize>>,
}

/// An order of points that are recorded in another format.
struct Other {
    name: &'static str,
    /// The numbers of points that detectors write of it: alone, and with others behind them.
    counts: &'static [usize],
    place: fn(Keypoint) -> Option<usize>,
}

const OTHERS: [Other; 3] = [
    // MediaPipe Pose; with hands, and with hands and face.
    Other { name: "mediapipe_33", counts: &[33, 75, 543, 553], place: mediapipe },
    // OpenPose COCO.
    Other { name: "openpose_18", counts: &[18], place: openpose_18 },
    // HALPE with face and hands.
    Other {
        name: "halpe_136",
        counts: &[136],
        place: |point| KeypointFormat::Halpe26.index_of(point),
    },
];

fn mediapipe(point: Keypoint) -> Option<usize> {
    let place = match point {
        K::Nose => 0,
        K::LEye => 2,
        K::REye => 5,
        K::LEar => 7,
        K::REar => 8,
        K::LShoulder => 11,
        K::RShoulder => 12,
        K::LElbow => 13,
        K::RElbow => 14,
        K::LWrist => 15,
        K::RWrist => 16,
        K::LHip => 23,
        K::RHip => 24,
        K::LKnee => 25,
        K::RKnee => 26,
        K::LAnkle => 27,
        K::RAnkle => 28,
        K::LHeel => 29,
        K::RHeel => 30,
        K::LBigToe => 31,
        K::RBigToe => 32,
        _ => return None,
    };
    Some(place)
}

fn openpose_18(point: Keypoint) -> Option<usize> {
    let order = [
        K::Nose,
        K::Neck,
        K::RShoulder,
        K::RElbow,
        K::RWrist,
        K::LShoulder,
        K::LElbow,
        K::LWrist,
        K::RHip,
        K::RKnee,
        K::RAnkle,
        K::LHip,
        K::LKnee,
        K::LAnkle,
        K::REye,
        K::LEye,
        K::REar,
        K::LEar,
    ];
    order.iter().position(|one| *one == point)
}

/// A mapping file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct MappingFile {
    /// Our names of points, and the detector's index (from 0) or name of each.
    points: BTreeMap<String, Place>,
    /// Number of the detector's points.
    count: Option<usize>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Place {
    Index(usize),
    Name(String),
}

impl Other {
    fn order(&self, len: Option<usize>) -> Option<PointOrder> {
        PointOrder::recorded(self.name, len, self.place)
    }
}

impl From<KeypointFormat> for PointOrder {
    fn from(format: KeypointFormat) -> Self {
        let index = (0..format.len()).map(Some).collect();
        Self { name: format.name().to_owned(), format, len: Some(format.len()), index }
    }
}

impl PointOrder {
    /// The order with that name.
    ///
    /// # Errors
    /// [`ImportError::UnknownFormat`], which lists the known ones.
    pub fn named(name: &str) -> Result<Self, ImportError> {
        if let Some(format) = KeypointFormat::from_name(name) {
            return Ok(format.into());
        }
        let known = OTHERS.iter().find(|other| other.name == name);
        let found = known.and_then(|other| match other.counts {
            [count] => other.order(Some(*count)),
            // Others may follow them.
            _ => other.order(None),
        });
        let formats = KeypointFormat::ALL.map(KeypointFormat::name);
        found.ok_or_else(|| {
            unknown_format(name, formats.into_iter().chain(OTHERS.map(|other| other.name)))
        })
    }

    /// The orders with that many points, the most usual first.
    pub fn of_count(count: usize) -> Vec<Self> {
        let formats = KeypointFormat::ALL.into_iter().filter(|format| format.len() == count);
        let others = OTHERS.iter().filter(|other| other.counts.contains(&count));
        let others = others.filter_map(|other| other.order(Some(count)));
        formats.map(Self::from).chain(others).collect()
    }

    /// Chooses the format: the smallest of those that have the most points with a place.
    fn recorded(
        name: &str,
        len: Option<usize>,
        place: impl Fn(Keypoint) -> Option<usize>,
    ) -> Option<Self> {
        let places = |format: KeypointFormat| format.keypoints().iter().map(|point| place(*point));
        let placed = |format: &KeypointFormat| places(*format).flatten().count();
        let best = |format: &KeypointFormat| (placed(format), std::cmp::Reverse(format.len()));
        let format = KeypointFormat::ALL.into_iter().rev().max_by_key(best)?;
        let (name, index) = (name.to_owned(), places(format).collect());
        (placed(&format) > 0).then_some(Self { name, format, len, index })
    }

    /// The order of points with names, such as `left_shoulder`, `LShoulder` or `shoulder.L`. Also the names
    /// that are no points of ours.
    pub fn of_names(names: &[String]) -> Option<(Self, Vec<String>)> {
        let points: Vec<Option<Keypoint>> = names.iter().map(|name| keypoint_of(name)).collect();
        let place = |keypoint| points.iter().position(|point| *point == Some(keypoint));
        let found = Self::recorded("by name", Some(names.len()), place)?;
        let is_left = |i: &usize| !found.index.contains(&Some(*i));
        let left = (0..names.len()).filter(is_left).map(|i| names[i].clone()).collect();
        Some((found, left))
    }

    /// Reads a mapping file. `names`: of the detector's points, if they have names.
    ///
    /// # Errors
    /// The file cannot be read, or names points that are not there.
    pub fn of_file(path: &Path, names: Option<&[String]>) -> Result<Self, ImportError> {
        let text = std::fs::read_to_string(path).map_err(|error| ImportError::read(path, error))?;
        let fault = |what: String| ImportError::Mapping { path: path.to_owned(), what };
        let file: MappingFile =
            toml::from_str(&text).map_err(|error| fault(error.message().to_owned()))?;
        let mut places = BTreeMap::new();
        for (point, place) in &file.points {
            let known =
                keypoint_of(point).ok_or_else(|| fault(format!("{point} is no point of ours")))?;
            let index = match (place, names) {
                (Place::Index(index), _) => *index,
                (Place::Name(name), Some(names)) => {
                    let found = names.iter().position(|other| other == name);
                    found.ok_or_else(|| {
                        fault(format!("{name} is not in the file, which has {}", names.join(", ")))
                    })?
                }
                (Place::Name(_), None) => {
                    return Err(fault(format!(
                        "{point}: the detections have no names, give an index"
                    )));
                }
            };
            if let Some(count) = file.count.filter(|count| index >= *count) {
                return Err(fault(format!("{point}: there is no index {index} of {count} points")));
            }
            places.insert(known, index);
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let place = |keypoint| places.get(&keypoint).copied();
        let found = Self::recorded(&name, file.count, place);
        let found = found.ok_or_else(|| fault("it has no points".into()))?;
        let kept = found.index.iter().flatten().count();
        if kept < places.len() {
            let what = format!(
                "no keypoint format has all these points; {} has {kept}",
                found.format.name()
            );
            return Err(fault(what));
        }
        Ok(found)
    }

    /// Whether a person may have that many points.
    pub fn takes(&self, count: usize) -> bool {
        let last = self.index.iter().flatten().max().copied().unwrap_or(0);
        self.len.map_or(count > last, |len| len == count)
    }

    /// How many points it needs, in words.
    pub(in crate::io::formats) fn needs(&self) -> String {
        let last = self.index.iter().flatten().max().copied().unwrap_or(0);
        self.len.map_or_else(|| format!("more than {last}"), |len| len.to_string())
    }

    /// The points in the format's order.
    pub fn put(&self, points: &[Option<Detection>]) -> Vec<Option<Detection>> {
        self.index.iter().map(|at| at.and_then(|at| points.get(at).copied().flatten())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_where_detectors_have_them() {
        for (name, places) in [
            (
                "openpose_18",
                [(K::Neck, 1), (K::RWrist, 4), (K::LElbow, 6), (K::LAnkle, 13), (K::LEar, 17)],
            ),
            (
                "halpe_136",
                [
                    (K::LShoulder, 5),
                    (K::RAnkle, 16),
                    (K::Neck, 18),
                    (K::LBigToe, 20),
                    (K::RHeel, 25),
                ],
            ),
            (
                "mediapipe_33",
                [(K::Nose, 0), (K::LEar, 7), (K::RWrist, 16), (K::LKnee, 25), (K::RBigToe, 32)],
            ),
        ] {
            let order = PointOrder::named(name).unwrap();
            for (point, place) in places {
                let ours = order.format.index_of(point).unwrap();
                assert_eq!(order.index[ours], Some(place), "{name} {point:?}");
            }
        }
        let takes = |name: &str, count| PointOrder::named(name).unwrap().takes(count);
        assert!(takes("mediapipe_33", 33) && takes("mediapipe_33", 553));
        assert!(takes("openpose_18", 18) && !takes("openpose_18", 25) && !takes("halpe_136", 133));
    }
}
