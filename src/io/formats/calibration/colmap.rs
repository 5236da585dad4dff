//! Reads COLMAP's text: `cameras.txt` and `images.txt`. Each image is a camera.
//!
//! An image has the rotation (quaternion w x y z) and the translation from the world to the camera, in the
//! reconstruction's own unit. The centre of the first pixel is (0.5, 0.5).

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::{Calibrated, Fault, natural_key, size_px};
use crate::core::camera::{CameraError, Lens};
use crate::core::so3;
use crate::core::time::Nanos;

/// Image size, matrix and lens of a camera.
type Inside = ([u32; 2], Matrix3<f64>, Lens);

/// Reads the texts of both files.
pub(super) fn cameras(cameras: &str, images: &str) -> Result<Vec<Calibrated>, Fault> {
    let inside = lines(cameras).map(|(number, line)| inside(number, line));
    let inside = inside.collect::<Result<BTreeMap<&str, Inside>, Fault>>()?;
    // After each image comes a line with its points, which may be empty.
    let mut images_and_points = images.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    let mut all = Vec::new();
    while let Some((number, line)) = images_and_points.next() {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        all.push(image(number, line, &inside)?);
        // The line of an image has a file name, that of points has only numbers.
        let has_name =
            |line: &str| line.split_whitespace().any(|word| word.parse::<f64>().is_err());
        if let Some((next, points)) = images_and_points.next()
            && has_name(points)
            && image(next, points, &inside).is_ok()
        {
            let what = "an image is here, where the points of the image before should be";
            let fix = "put an empty line after each image without points";
            return Err(Fault::Text(format!("images.txt line {next}: {what}; {fix}")));
        }
    }
    // cam01/0001.png is of cam01, as cam01.png; images/cam01.png too, if all images are in that folder.
    let folder = |camera: &Calibrated| Path::new(&camera.name).parent().map(Path::to_owned);
    let folders: BTreeSet<_> = all.iter().map(folder).collect();
    for camera in &mut all {
        let path = Path::new(&camera.name);
        let own = path.parent().and_then(Path::file_name).filter(|_| folders.len() > 1);
        let name = own.or_else(|| path.file_stem()).unwrap_or_default();
        camera.name = name.to_string_lossy().into_owned();
    }
    all.sort_by_cached_key(|camera| natural_key(&camera.name));
    // Images of a camera that stands still.
    all.dedup_by(|one, other| {
        one.name == other.name
            && (one.rotation, one.translation) == (other.rotation, other.translation)
    });
    if let Some(pair) = all.windows(2).find(|pair| pair[0].name == pair[1].name) {
        let name = &pair[0].name;
        return Err(Fault::Text(format!(
            "images.txt: the images of {name} have different poses; leave one of them in it"
        )));
    }
    Ok(all)
}

/// The lines without comments, with their numbers.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let numbered = text.lines().enumerate().map(|(i, line)| (i + 1, line.trim()));
    numbered.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn number(file: &str, line: usize, word: &str) -> Result<f64, Fault> {
    word.parse().map_err(|_| Fault::Text(format!("{file} line {line}: {word} is not a number")))
}

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`
fn inside(line: usize, text: &str) -> Result<(&str, Inside), Fault> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let fault = |what: &str| Fault::Text(format!("cameras.txt line {line}: {what}"));
    let [id, model, width, height, ref rest @ ..] = words[..] else {
        return Err(fault("needs CAMERA_ID MODEL WIDTH HEIGHT PARAMS"));
    };
    let number = |word: &&str| number("cameras.txt", line, word);
    let numbers = rest.iter().map(number).collect::<Result<Vec<_>, _>>()?;
    let size = size_px(id, [number(&width)?, number(&height)?])?;
    let brown = |k: &[f64]| Lens::brown_conrady(k);
    let fisheye = |k: &[f64]| Lens::fisheye(k);
    let (focal, centre, lens): (_, _, Result<Lens, CameraError>) = match (model, &numbers[..]) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f], [cx, cy], Ok(Lens::IDEAL)),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy], [cx, cy], Ok(Lens::IDEAL)),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f], [cx, cy], brown(&[k, 0.0, 0.0, 0.0])),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f], [cx, cy], brown(&[k1, k2, 0.0, 0.0])),
        ("OPENCV" | "FULL_OPENCV", &[fx, fy, cx, cy, ref k @ ..]) => ([fx, fy], [cx, cy], brown(k)),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k]) => {
            ([f, f], [cx, cy], fisheye(&[k, 0.0, 0.0, 0.0]))
        }
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => {
            ([f, f], [cx, cy], fisheye(&[k1, k2, 0.0, 0.0]))
        }
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, ref k @ ..]) => ([fx, fy], [cx, cy], fisheye(k)),
        _ => return Err(fault(&format!("{model} with {} parameters is not known", numbers.len()))),
    };
    let lens = lens.map_err(|error| fault(&error.to_string()))?;
    let ([fx, fy], [cx, cy]) = (focal, centre);
    Ok((id, (size, Matrix3::new(fx, 0.0, cx - 0.5, 0.0, fy, cy - 0.5, 0.0, 0.0, 1.0), lens)))
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; the camera's name is the image's.
fn image(line: usize, text: &str, inside: &BTreeMap<&str, Inside>) -> Result<Calibrated, Fault> {
    let fault = |what: &str| Fault::Text(format!("images.txt line {line}: {what}"));
    // The name may have spaces.
    let words: Vec<&str> = text.splitn(10, ' ').collect();
    let [_, w, x, y, z, tx, ty, tz, id, path] = words[..] else {
        return Err(fault("needs IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"));
    };
    let number = |word| number("images.txt", line, word);
    let xyzw = [number(x)?, number(y)?, number(z)?, number(w)?];
    let rotation =
        so3::rotation_from_xyzw(xyzw).ok_or_else(|| fault("no rotation in QW QX QY QZ"))?;
    let known = inside.get(id);
    let (size, matrix, lens) =
        *known.ok_or_else(|| fault(&format!("no camera {id} in cameras.txt")))?;
    Ok(Calibrated {
        name: path.to_owned(),
        size: Some(size),
        matrix,
        lens,
        rotation,
        translation: Vector3::new(number(tx)?, number(ty)?, number(tz)?),
        time_offset: Nanos::ZERO,
    })
}
