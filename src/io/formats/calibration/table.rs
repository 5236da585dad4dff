//! Cameras in files of named fields (TOML, JSON, YAML, XML and pickles), whatever the fields are called.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use nalgebra::{Matrix3, Vector3};
use serde_json::{Map, Value, json};

use super::{Calibrated, Fault, natural_key, size_px};
use crate::core::camera::Lens;
use crate::core::so3;
use crate::core::time::Nanos;

/// A field of a camera, and the names that it has in files, in lower case without separators. A name that
/// comes first is preferred.
const FIELDS: [(&str, &[&str]); 12] = [
    ("name", &["name", "cameraname", "camid", "id", "serial"]),
    ("size", &["size", "resolution", "imagesize", "imgsize", "res"]),
    (
        "matrix",
        &[
            "matrix",
            "k",
            "cameramatrix",
            "intrinsicmatrix",
            "intrinsicmat",
            "calibrationmatrix",
            "intrinsics",
            "intrinsic",
            "mtx",
        ],
    ),
    (
        "distortions",
        &[
            "distortions",
            "distcoef",
            "distcoeff",
            "distcoeffs",
            "distortioncoefficients",
            "distortioncoeffs",
            "distortion",
            "dist",
            "d",
        ],
    ),
    ("rotation", &["rotation", "rot", "rotationmatrix", "r", "rvec"]),
    ("translation", &["translation", "t", "tvec"]),
    ("pose", &["extrinsics", "extrinsic", "extrinsicmatrix", "rt", "worldtocamera"]),
    ("width", &["width", "imagewidth", "w"]),
    ("height", &["height", "imageheight", "h"]),
    ("fisheye", &["fisheye", "fisheyemodel", "isfisheye"]),
    ("ignore", &["ignore"]),
    ("model", &["distortionmodel", "cameramodel", "model"]),
];
/// Fields that only cameras have.
const OF_CAMERAS: [&str; 5] = ["matrix", "distortions", "rotation", "translation", "pose"];
/// Kalibr's pose of a camera in the one before.
const CHAIN: &str = "T_cn_cnm1";
/// Lens models that are the equidistant fisheye.
const FISHEYE: [&str; 4] = ["equidistant", "fisheye", "opencv_fisheye", "kannala_brandt"];
/// Lens models that are pinhole or Brown-Conrady.
const PINHOLE: [&str; 11] = [
    "pinhole",
    "radtan",
    "plumb_bob",
    "perspective",
    "standard",
    "opencv",
    "rational",
    "rational_polynomial",
    "thin_prism",
    "tilted",
    "none",
];

/// Fields of cameras, by the cameras' names. Several files may each hold a part.
#[derive(Default)]
pub(super) struct Tables {
    cameras: BTreeMap<Name, Map<String, Value>>,
    /// Where in the file each camera's pose is.
    places: BTreeMap<String, String>,
    /// Whether something has the name of the chosen set.
    pub has_set: bool,
    pub notes: Vec<String>,
}

/// A camera's name, in natural order.
type Name = (Vec<(String, usize, String)>, String);

impl Tables {
    /// Adds the cameras of a file. `name`: of the camera, if the file is one camera's. `set`: see
    /// [`Convention`](super::Convention).
    pub fn add(&mut self, tree: &Value, name: &str, set: Option<&str>) -> Result<(), Fault> {
        if let Some(names) = names_of_easymocap(tree) {
            return names.into_iter().try_for_each(|name| {
                let ending = format!("_{name}");
                let fields = tree.as_object().into_iter().flatten();
                let own = fields.filter_map(|(key, value)| {
                    Some((key.strip_suffix(&ending)?.to_owned(), value.clone()))
                });
                self.put(&name, own.collect(), &["", ""])
            });
        }
        match stereo(tree) {
            Some([first, second]) => {
                self.put("camera1", first, &["", ""])?;
                self.put("camera2", second, &["", ""])
            }
            None => self.walk(tree, &[name], set),
        }
    }

    /// Finds cameras below a node.
    fn walk(&mut self, node: &Value, path: &[&str], set: Option<&str>) -> Result<(), Fault> {
        let (own, parent) = (path[path.len() - 1], path[path.len().saturating_sub(2)]);
        match node {
            Value::Object(fields) if OF_CAMERAS.iter().any(|one| is_number(fields, one)) => {
                let name = field(fields, "name").map(text).filter(|name| !name.is_empty());
                self.put(&name.unwrap_or_else(|| own.to_owned()), fields.clone(), path)
            }
            Value::Object(fields) => {
                let chosen = set.and_then(|set| fields.get(set));
                self.has_set |= chosen.is_some();
                let is_left = |key: &str, value: &Value| {
                    set != Some(key) && chosen.is_some_and(|chosen| are_rivals(chosen, value))
                };
                let kept = fields.iter().filter(|(key, value)| !is_left(key, value));
                kept.into_iter().try_for_each(|(key, value)| {
                    self.walk(value, &[path, &[key.as_str()]].concat(), set)
                })
            }
            // A field by cameras: {"R": {"cam01": ...}}.
            Value::Array(all) if all.iter().all(|one| !one.is_object()) => {
                match path.len() > 2 && canonical(parent).is_some() {
                    true => {
                        self.put(own, Map::from_iter([(parent.to_owned(), node.clone())]), path)
                    }
                    false => Ok(()),
                }
            }
            Value::Array(all) => all.iter().enumerate().try_for_each(|(i, value)| {
                self.walk(value, &[path, &[i.to_string().as_str()]].concat(), set)
            }),
            _ => Ok(()),
        }
    }

    /// Adds fields to a camera.
    fn put(&mut self, name: &str, fields: Map<String, Value>, path: &[&str]) -> Result<(), Fault> {
        // The subject, or the camera with the same name.
        let place = path[path.len() - if path.len() > 2 { 2 } else { 1 }];
        // multical: the pose of cam2 is cam2_to_cam1.
        let name = match name.split_once("_to_") {
            Some((first, _)) if field(&fields, "matrix").is_none() => first,
            _ => name,
        };
        let camera = self.cameras.entry((natural_key(name), name.to_owned())).or_default();
        for (key, value) in fields {
            if OF_CAMERAS.iter().any(|one| canonical(&key) == Some(one)) {
                let other = self.places.entry(format!("{name} {key}")).or_insert(place.to_owned());
                if camera.get(&key).is_some_and(|known| *known != value) {
                    return Err(Fault::Text(format!(
                        "camera {name}: {key} is there twice, in {other} and in {place}; choose one with --set; if these are two cameras, rename one"
                    )));
                }
            }
            camera.insert(key, value);
        }
        Ok(())
    }

    /// The cameras, in natural order of their names.
    pub fn cameras(mut self) -> Result<(Vec<Calibrated>, Vec<String>), Fault> {
        let is_ignored = |fields: &Map<_, _>| field(fields, "ignore") == Some(&Value::Bool(true));
        for ((_, name), _) in self.cameras.iter().filter(|(_, fields)| is_ignored(fields)) {
            self.notes.push(format!("camera {name} is left out: the file says ignore"));
        }
        self.cameras.retain(|_, fields| !is_ignored(fields));
        // Caliscope has poses of pairs of cameras, too.
        let has_matrix = |fields: &Map<_, _>| field(fields, "matrix").is_some();
        if self.cameras.values().any(has_matrix) {
            for ((_, name), _) in self.cameras.iter().filter(|(_, fields)| !has_matrix(fields)) {
                self.notes.push(format!("{name} is left out: it has no matrix"));
            }
            self.cameras.retain(|_, fields| has_matrix(fields));
        }
        if self.cameras.is_empty() {
            return Err(Fault::Text(
                "no camera: nothing has a matrix, rotation or translation".into(),
            ));
        }
        let chained = self.cameras.values().any(|fields| fields.contains_key(CHAIN));
        let mut before = chained.then(|| (Matrix3::identity(), Vector3::zeros()));
        let mut all = Vec::new();
        for ((_, name), fields) in &self.cameras {
            let camera = Fields { name, fields };
            if let Some((r, t)) = &mut before
                && fields.contains_key(CHAIN)
            {
                let (by, along) = pose(&camera.numbers_of(CHAIN, &fields[CHAIN])?)
                    .ok_or_else(|| camera.fault(CHAIN, "is no pose of 3 x 4 or 4 x 4"))?;
                (*r, *t) = (by * *r, by * *t + along);
            }
            all.push(camera.calibrated(before)?);
        }
        Ok((all, self.notes))
    }
}

/// Whether both have the same fields of the same cameras.
fn are_rivals(one: &Value, other: &Value) -> bool {
    let (Value::Object(one), Value::Object(other)) = (one, other) else { return false };
    let share = |(name, of_one): (&String, &Value)| {
        let (Some(of_one), Some(of_other)) =
            (of_one.as_object(), other.get(name).and_then(Value::as_object))
        else {
            return false;
        };
        OF_CAMERAS
            .iter()
            .any(|name| field(of_one, name).is_some() && field(of_other, name).is_some())
    };
    one.iter().any(share)
}

/// The names of cameras in EasyMocap's files: `names`, and fields such as `K_01`.
fn names_of_easymocap(tree: &Value) -> Option<Vec<String>> {
    let names = tree.get("names")?.as_array()?.iter().map(text).collect::<Vec<_>>();
    let of_first = format!("_{}", names.first()?);
    tree.as_object()?.keys().any(|key| key.ends_with(&of_first)).then_some(names)
}

/// The two cameras of OpenCV's stereo calibration: fields such as `M1` and `D2`; `R` and `T` are the pose of the second in
/// the first. Files may have a part of the fields.
fn stereo(tree: &Value) -> Option<[Map<String, Value>; 2]> {
    let fields = tree.as_object()?;
    let own = |number: &str| -> Map<String, Value> {
        let own = fields.iter().filter_map(|(key, value)| {
            let key = key.strip_suffix(number)?;
            let key = if key == "M" { "matrix" } else { key };
            let count = numbers(value).map_or(0, |numbers| numbers.len());
            let is_inside = match canonical(key)? {
                "matrix" => count == 9,
                "distortions" => count >= 4,
                _ => false,
            };
            is_inside.then(|| (key.to_owned(), value.clone()))
        });
        own.collect()
    };
    let [mut first, mut second] = ["1", "2"].map(own);
    // They are also of the rectified images.
    let is_of_pair = fields.contains_key("R1") && fields.contains_key("R2");
    if (first.is_empty() || second.is_empty()) && !is_of_pair {
        return None;
    }
    if let (Some(rotation), Some(translation)) = (fields.get("R"), fields.get("T")) {
        let none = (json!([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), json!([0, 0, 0]));
        first.extend([("R".to_owned(), none.0), ("T".to_owned(), none.1)]);
        second
            .extend([("R", rotation), ("T", translation)].map(|(k, v)| (k.to_owned(), v.clone())));
    }
    let of_both = ["size", "width", "height", "fisheye", "model"];
    let is_of_both = |key: &str| canonical(key).is_some_and(|field| of_both.contains(&field));
    for (key, value) in fields.iter().filter(|(key, _)| is_of_both(key)) {
        first.insert(key.clone(), value.clone());
        second.insert(key.clone(), value.clone());
    }
    Some([first, second])
}

/// A name in lower case without separators.
fn plain(name: &str) -> String {
    let letters = name.chars().filter(char::is_ascii_alphanumeric);
    letters.map(|c| c.to_ascii_lowercase()).collect()
}

/// The field that a name in a file means.
fn canonical(name: &str) -> Option<&'static str> {
    let plain = plain(name);
    FIELDS.iter().find(|(_, names)| names.contains(&&*plain)).map(|(field, _)| *field)
}

/// A field by all its names.
fn field<'a>(fields: &'a Map<String, Value>, wanted: &str) -> Option<&'a Value> {
    let (_, names) = FIELDS.iter().find(|(field, _)| *field == wanted)?;
    let place = |key: &str| {
        let plain = plain(key);
        names.iter().position(|name| *name == plain)
    };
    let present = fields.iter().filter(|(_, value)| !value.is_null());
    let named = present.filter_map(|(key, value)| Some((place(key)?, value)));
    named.min_by_key(|(place, _)| *place).map(|(_, value)| value)
}

/// Whether a field is there and holds numbers, no objects.
fn is_number(fields: &Map<String, Value>, wanted: &str) -> bool {
    field(fields, wanted).is_some_and(|value| !numbers(value).unwrap_or_default().is_empty())
}

/// The numbers of a value, row by row.
fn numbers(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::Number(number) => Some(vec![number.as_f64()?]),
        Value::Array(all) => {
            let all = all.iter().map(numbers).collect::<Option<Vec<_>>>()?;
            Some(all.concat())
        }
        // OpenCV's matrices.
        Value::Object(matrix) => numbers(matrix.get("data")?),
        _ => None,
    }
}

fn text(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Rotation and translation of a matrix of 3 x 4, or of 4 x 4 with 0, 0, 0, 1 in the last row.
fn pose(numbers: &[f64]) -> Option<(Matrix3<f64>, Vector3<f64>)> {
    let row = |i: usize| &numbers[4 * i..4 * i + 4];
    let is_last =
        |row: &[f64]| row.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(a, b)| (a - b).abs() < 1e-6);
    (numbers.len() == 12 || numbers.len() == 16 && is_last(row(3))).then(|| {
        let rows = [row(0), row(1), row(2)];
        (Matrix3::from_fn(|i, j| rows[i][j]), Vector3::from_fn(|i, _| rows[i][3]))
    })
}

/// The fields of a camera.
struct Fields<'a> {
    name: &'a str,
    fields: &'a Map<String, Value>,
}

impl Fields<'_> {
    fn fault(&self, field: &str, what: &str) -> Fault {
        Fault::Text(format!("camera {}: {field} {what}", self.name))
    }

    fn numbers_of(&self, name: &str, value: &Value) -> Result<Vec<f64>, Fault> {
        numbers(value).ok_or_else(|| self.fault(name, "holds something that is no number"))
    }

    /// The numbers of a field, if it is there.
    fn numbers(&self, name: &str) -> Result<Option<Vec<f64>>, Fault> {
        field(self.fields, name).map(|value| self.numbers_of(name, value)).transpose()
    }

    fn required(&self, name: &str) -> Result<Vec<f64>, Fault> {
        self.numbers(name)?.ok_or_else(|| self.fault(name, "is missing"))
    }

    /// The camera. `chained`: its pose, if the poses are a chain.
    fn calibrated(
        &self,
        chained: Option<(Matrix3<f64>, Vector3<f64>)>,
    ) -> Result<Calibrated, Fault> {
        let matrix = match self.required("matrix")?[..] {
            [fx, fy, cx, cy] => Matrix3::new(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
            ref nine if nine.len() == 9 => Matrix3::from_row_slice(nine),
            _ => return Err(self.fault("matrix", "must have 3 x 3 numbers, or fx, fy, cx, cy")),
        };
        let size = self.size()?;
        let (rotation, translation) = match (chained, self.numbers("pose")?) {
            (Some(pose), _) => pose,
            (None, Some(numbers)) => pose(&numbers).ok_or_else(|| {
                let what = "must be a matrix of 3 x 4, or of 4 x 4 with 0, 0, 0, 1 in the last row";
                self.fault("extrinsics", what)
            })?,
            (None, None) => (self.rotation()?, self.translation()?),
        };
        let time_offset = match self.fields.get("time_offset_ms").map(Value::as_f64) {
            None => Nanos::ZERO,
            Some(Some(ms)) => Nanos::rounded(ms * 1e6),
            Some(None) => return Err(self.fault("time_offset_ms", "is no number")),
        };
        let (name, lens) = (self.name.to_owned(), self.lens()?);
        Ok(Calibrated { name, size, matrix, lens, rotation, translation, time_offset })
    }

    /// The image size, if the file has it.
    fn size(&self) -> Result<Option<[u32; 2]>, Fault> {
        let both = (self.numbers("width")?, self.numbers("height")?);
        let given = match (self.numbers("size")?, both) {
            (Some(mut size), _) if size.len() == 2 => {
                // OpenCap's are height and width.
                if self.fields.contains_key("intrinsicMat") {
                    size.reverse();
                }
                Some([size[0], size[1]])
            }
            (Some(_), _) => return Err(self.fault("size", "must be width and height")),
            (None, (Some(width), Some(height))) if width.len() + height.len() == 2 => {
                Some([width[0], height[0]])
            }
            _ => None,
        };
        given.map(|size| size_px(self.name, size)).transpose()
    }

    fn rotation(&self) -> Result<Matrix3<f64>, Fault> {
        match self.required("rotation")?[..] {
            [x, y, z] if Vector3::new(x, y, z).norm() > 2.01 * PI => {
                Err(self
                    .fault("rotation", "is more than a turn; give the rotation vector in radians"))
            }
            [x, y, z] => Ok(so3::exp(&Vector3::new(x, y, z))),
            ref nine if nine.len() == 9 => Ok(Matrix3::from_row_slice(nine)),
            _ => Err(self.fault("rotation", "must have 3 numbers (a rotation vector) or 3 x 3")),
        }
    }

    fn translation(&self) -> Result<Vector3<f64>, Fault> {
        match self.required("translation")?[..] {
            [x, y, z] => Ok(Vector3::new(x, y, z)),
            _ => Err(self.fault("translation", "must have 3 numbers")),
        }
    }

    fn lens(&self) -> Result<Lens, Fault> {
        let model = field(self.fields, "model").map(|model| text(model).to_lowercase());
        let coefficients = self.numbers("distortions")?.unwrap_or_else(|| vec![0.0; 4]);
        let is_fisheye =
            field(self.fields, "fisheye").is_some_and(|is| *is == Value::Bool(true) || *is == 1);
        let lens = match model.as_deref() {
            _ if is_fisheye => Lens::fisheye(&coefficients),
            Some(model) if FISHEYE.contains(&model) => Lens::fisheye(&coefficients),
            Some(model) if !PINHOLE.contains(&model) => {
                let what = format!("is {model}; only pinhole and fisheye cameras can be used");
                return Err(self.fault("model", &what));
            }
            _ if coefficients.is_empty() => Ok(Lens::IDEAL),
            _ => Lens::brown_conrady(&coefficients),
        };
        lens.map_err(|error| self.fault("distortions", &error.to_string()))
    }
}
