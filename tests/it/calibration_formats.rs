//! Calibrations of other programs: a point lands on the same pixel, whatever the format, unit and axes.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;

use bundlemocap::core::camera::{Camera, Lens, Rig};
use bundlemocap::core::so3;
use bundlemocap::io::formats::{Calibration, Convention, Up, read_calibration, write_opencv};
use bundlemocap::research::synth::ring_rig;
use nalgebra::{Matrix3, Vector3};
use serde_json::{Value, json};
use tempfile::TempDir;

/// Four cameras around the stage, no two alike.
fn rig() -> Rig {
    let mut rig = ring_rig(4, 4.0, 1.6).unwrap();
    for (i, camera) in rig.cameras.iter_mut().enumerate() {
        let bend = 0.02 * i as f64;
        let lens = Lens::BrownConrady([-0.1 - bend, 0.04, 0.001, -0.002, 0.003, 0.0, 0.0, 0.0]);
        *camera = with_lens(camera, lens);
        camera.focal.x += 11.0 * i as f64;
        camera.centre.y -= 3.0;
    }
    rig
}

/// The same with a fisheye, for formats that have them.
fn rig_with_fisheye() -> Rig {
    let mut rig = rig();
    rig.cameras[1] = with_lens(&rig.cameras[1], Lens::Fisheye([0.01, -0.002, 0.0003, 0.0001]));
    rig
}

fn with_lens(of: &Camera, lens: Lens) -> Camera {
    let size = [of.width, of.height];
    let (rotation, translation) = (of.rotation, of.translation);
    Camera::new(of.name.clone(), size, &of.matrix(), lens, rotation, translation).unwrap()
}

/// A camera as a file has it: numbers row by row, the pose from a world with another up axis and unit.
struct InFile {
    name: String,
    size: [u32; 2],
    k: [[f64; 3]; 3],
    lens: Vec<f64>,
    is_fisheye: bool,
    r: Matrix3<f64>,
    t: Vector3<f64>,
}

impl InFile {
    fn all(rig: &Rig, up: Up, unit: f64) -> Vec<Self> {
        let of = |camera: &Camera| Self {
            name: camera.name.clone(),
            size: [camera.width, camera.height],
            k: rows(&camera.matrix()),
            lens: camera.lens().coefficients().iter().copied().take(5).collect(),
            is_fisheye: matches!(camera.lens(), Lens::Fisheye(_)),
            r: camera.rotation * up.calibration_from_world().transpose(),
            t: camera.translation / unit,
        };
        rig.cameras.iter().map(of).collect()
    }

    fn r(&self) -> [[f64; 3]; 3] {
        rows(&self.r)
    }

    fn t(&self) -> [f64; 3] {
        self.t.into()
    }

    fn rotation_vector(&self) -> [f64; 3] {
        so3::log(&self.r).into()
    }

    fn centre(&self) -> Vector3<f64> {
        -(self.r.transpose() * self.t)
    }
}

fn rows(matrix: &Matrix3<f64>) -> [[f64; 3]; 3] {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| matrix[(i, j)]))
}

/// Writes a text into a new folder and returns both.
fn file(name: &str, bytes: impl AsRef<[u8]>) -> (TempDir, std::path::PathBuf) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    (folder, path)
}

fn read(path: &Path) -> Calibration {
    read_calibration(path, &Convention::default()).unwrap()
}

/// Points of a performer's size land on the rig's own pixels. `world`: where the file's world is in ours.
fn lands(found: &Calibration, rig: &Rig, world: impl Fn(&Vector3<f64>) -> Vector3<f64>, px: f64) {
    assert_eq!(found.rig.cameras.len(), rig.cameras.len());
    let mut worst: f64 = 0.0;
    for (read, camera) in found.rig.cameras.iter().zip(&rig.cameras) {
        assert_eq!(read.name, camera.name);
        for i in 0..20 {
            let point = Vector3::new(0.1 * f64::from(i % 5) - 0.2, 0.1 * f64::from(i), 0.3);
            let theirs = found.up.calibration_from_world().transpose() * world(&point);
            let (ours, theirs) = (camera.project(&point).unwrap(), read.project(&theirs).unwrap());
            worst = worst.max((ours - theirs).norm());
            assert!(worst < px, "{}: {ours} {theirs}", camera.name);
        }
    }
    println!("{}, {} up, {}: at most {worst:.1e} px", found.format, found.up, found.unit);
}

/// As [`lands`], for a file in the usual axes that needs no note.
fn is_read(path: &Path, rig: &Rig, format: &str, [up, unit]: [&str; 2]) -> Calibration {
    let found = read(path);
    let said = (found.format, &*found.up.to_string(), &*found.unit.to_string());
    assert_eq!(said, (format, up, unit), "{}", path.display());
    let of_file = found.up.calibration_from_world();
    lands(&found, rig, |point| of_file * point, 1e-6);
    found
}

/// The axes and units that are tried.
const WORLDS: [(Up, [&str; 2], f64); 4] = [
    (Up::Z, ["z", "m"], 1.0),
    (Up::Y, ["y", "mm"], 1e-3),
    (Up::MinusY, ["-y", "cm"], 1e-2),
    (Up::X, ["x", "mm"], 1e-3),
];

fn pose2sim(cameras: &[InFile]) -> String {
    let mut text = String::new();
    for camera in cameras {
        let InFile { name, size, k, lens, is_fisheye, .. } = camera;
        let _ = writeln!(
            text,
            "[{name}]\nname = \"{name}\"\nsize = {:?}\nmatrix = {k:?}\ndistortions = {lens:?}\n\
             rotation = {:?}\ntranslation = {:?}\nfisheye = {is_fisheye}\n",
            size.map(f64::from),
            camera.rotation_vector(),
            camera.t()
        );
    }
    text + "[metadata]\nadjusted = false\nerror = 0.0\n"
}

#[test]
fn toml_of_pose2sim_and_freemocap_is_read_in_any_unit_and_axes() {
    let rig = rig_with_fisheye();
    for (up, said, unit) in WORLDS {
        let (_folder, path) = file("Calib.toml", pose2sim(&InFile::all(&rig, up, unit)));
        let found = is_read(&path, &rig, "TOML", said);
        assert!(found.notes.is_empty(), "{:?}", found.notes);
    }
}

#[test]
fn a_file_without_image_sizes_takes_images_of_about_the_size_of_the_lens() {
    let text = pose2sim(&InFile::all(&rig(), Up::Z, 1.0));
    let text: Vec<&str> = text.lines().filter(|line| !line.starts_with("size")).collect();
    let (_folder, path) = file("Calib.toml", text.join("\n"));
    let found = read(&path);
    assert_eq!(found.without_size.len(), found.rig.cameras.len());
    for camera in &found.rig.cameras {
        let [width, height] = [camera.width, camera.height];
        assert!(camera.is_of_size([width, height]) && camera.is_of_size([width + 13, height]));
        assert!(!camera.is_of_size([width / 2, height / 2]), "halved");
        let scaled = [width, height].map(|px| (f64::from(px) * 1.05).round() as u32);
        assert!(!camera.is_of_size(scaled), "scaled");
    }
}

#[test]
fn poses_that_are_none_are_refused() {
    for (wrong, said) in [
        ("rotation = [170.0, 20.0, 3.0]", "rotation"),
        (
            "extrinsics = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]",
            "extrinsics must be a matrix of 3 x 4",
        ),
    ] {
        let text = pose2sim(&InFile::all(&rig(), Up::Z, 1.0));
        let text = text.replacen("rotation = [", &format!("{wrong}\nwas = ["), 1);
        let (_folder, path) = file("Calib.toml", text);
        let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn toml_of_caliscope_is_read_without_ignored_cameras() {
    let rig = rig();
    let mut text =
        String::from("creation_date = \"2026\"\n[cameras.9]\ncam_id = 9\nignore = true\n");
    let _ = writeln!(text, "matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]");
    for camera in InFile::all(&rig, Up::Z, 1.0) {
        let InFile { name, size, k, lens, .. } = &camera;
        let _ = writeln!(
            text,
            "[cameras.{name}]\ncam_id = \"{name}\"\nrotation_count = 0\nerror = 0.2\nsize = {size:?}\n\
             matrix = {k:?}\ndistortions = {lens:?}\nrotation = {:?}\ntranslation = {:?}\nignore = false",
            camera.r(),
            camera.t()
        );
    }
    text += "[stereo_1_2]\nrotation = [0.1, 0.2, 0.3]\ntranslation = [1.0, 0.0, 0.0]\nRMSE = 0.5\n";
    let (_folder, path) = file("config.toml", text);
    let found = is_read(&path, &rig, "TOML", ["z", "m"]);
    let left =
        ["camera 9 is left out: the file says ignore", "stereo_1_2 is left out: it has no matrix"];
    assert_eq!(found.notes, left);
}

#[test]
fn json_of_panoptic_studio_human36m_and_multical_is_read() {
    let rig = rig();
    let column = |v: [f64; 3]| v.map(|number| [number]);
    let panoptic = |camera: &InFile| {
        json!({ "name": camera.name, "type": "hd", "resolution": camera.size, "panel": 0, "node": 1,
            "K": camera.k, "distCoef": camera.lens, "R": camera.r(), "t": column(camera.t()) })
    };
    let all: Vec<Value> = InFile::all(&rig, Up::MinusY, 1e-2).iter().map(panoptic).collect();
    let text = json!({ "calibDataSource": "160422", "cameras": all }).to_string();
    let (_folder, path) = file("calibration_160422.json", text);
    is_read(&path, &rig, "JSON", ["-y", "cm"]);

    let cameras = InFile::all(&rig, Up::Z, 1e-3);
    let section = |of: &dyn Fn(&InFile) -> Value| -> Value {
        cameras.iter().map(|camera| (camera.name.clone(), of(camera))).collect()
    };
    let inside = section(&|c| json!({ "calibration_matrix": c.k, "distortion": c.lens }));
    let outside = section(&|c| json!({ "R": c.r(), "t": column(c.t()) }));
    let size = section(&|c| json!(c.size));
    let text = |sets: Value| {
        json!({ "intrinsics": inside, "extrinsics": sets, "res": size, "fps": 50 }).to_string()
    };
    let (_folder, path) = file("cameras.json", text(json!({ "S9": outside })));
    is_read(&path, &rig, "JSON", ["z", "mm"]);
    let moved = section(&|c| json!({ "R": c.r(), "t": [[1.0], [2.0], [3.0]] }));
    let (_folder, path) = file("one.json", text(json!({ "S9": outside })));
    let given = Convention { set: Some("S8".into()), ..Convention::default() };
    let error = read_calibration(&path, &given).unwrap_err().to_string();
    assert!(error.contains("nothing in it is named S8"), "{error}");
    let (_folder, path) = file("cameras.json", text(json!({ "S9": outside, "S11": moved })));
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("is there twice, in S11 and in S9; choose one with --set"), "{error}");
    let given = Convention { set: Some("S9".into()), ..Convention::default() };
    lands(
        &read_calibration(&path, &given).unwrap(),
        &rig,
        |p| Up::Z.calibration_from_world() * p,
        1e-6,
    );

    let cameras = InFile::all(&rig, Up::Z, 1.0);
    let section = |of: &dyn Fn(&InFile) -> Value| -> Value {
        cameras.iter().map(|camera| (camera.name.clone(), of(camera))).collect()
    };
    let inside = section(
        &|c| json!({ "model": "standard", "image_size": c.size, "K": c.k, "dist": [c.lens] }),
    );
    // The master has its own name, the others are relative to it by their names.
    let pose = |(i, c): (usize, &InFile)| {
        let name =
            if i == 0 { c.name.clone() } else { format!("{}_to_{}", c.name, cameras[0].name) };
        (name, json!({ "R": c.r(), "T": c.t() }))
    };
    let outside: Value = cameras.iter().enumerate().map(pose).collect();
    let text = json!({ "cameras": inside, "camera_poses": outside }).to_string();
    let (_folder, path) = file("calibration.json", text);
    is_read(&path, &rig, "JSON", ["z", "m"]);
}

/// A matrix in OpenCV's YAML.
fn opencv(name: &str, rows: usize, numbers: &[f64]) -> String {
    let columns = numbers.len() / rows;
    format!(
        "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {numbers:?}\n"
    )
}

#[test]
fn yaml_of_easymocap_is_read_from_both_files() {
    let rig = rig();
    let cameras = InFile::all(&rig, Up::Z, 1.0);
    let names: String = cameras.iter().map(|c| format!("  - \"{}\"\n", c.name)).collect();
    let (mut intri, mut extri) = [0; 2].map(|_| format!("%YAML:1.0\n---\nnames:\n{names}")).into();
    for camera in &cameras {
        let InFile { name, size: [width, height], k, lens, .. } = camera;
        intri += &opencv(&format!("K_{name}"), 3, k.as_flattened());
        intri += &opencv(&format!("dist_{name}"), 1, lens);
        intri += &format!("H_{name}: {height}\nW_{name}: {width}\n");
        extri += &opencv(&format!("R_{name}"), 3, &camera.rotation_vector());
        extri += &opencv(&format!("Rot_{name}"), 3, camera.r().as_flattened());
        extri += &opencv(&format!("T_{name}"), 3, &camera.t());
    }
    let (folder, path) = file("intri.yml", intri);
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("camera cam01: rotation is missing"), "{error}");
    fs::write(folder.path().join("extri.yml"), extri).unwrap();
    for path in [folder.path(), &path, &folder.path().join("extri.yml")] {
        is_read(path, &rig, "YAML", ["z", "m"]);
    }
}

#[test]
fn yaml_of_kalibr_is_read_in_the_first_cameras_axes() {
    let rig = rig_with_fisheye();
    let (mut text, mut before) = (String::new(), (Matrix3::identity(), Vector3::zeros()));
    for (i, camera) in InFile::all(&rig, Up::Y, 1.0).iter().enumerate() {
        let InFile { name, size, k, lens, .. } = camera;
        let [[fx, _, cx], [_, fy, cy], _] = k;
        let model = if camera.is_fisheye { "equidistant" } else { "radtan" };
        let (by, along) = (camera.r * before.0, camera.t - camera.r * before.0 * before.1);
        let _ = writeln!(
            text,
            "{name}:\n  camera_model: pinhole\n  intrinsics: [{fx}, {fy}, {cx}, {cy}]\n  \
             distortion_model: {model}\n  distortion_coeffs: {lens:?}\n  resolution: {size:?}\n  \
             rostopic: /{name}/image_raw\n  cam_overlaps: []"
        );
        if i > 0 {
            let _ = writeln!(text, "  T_cn_cnm1:");
            for (row, shift) in rows(&by).iter().zip(along.iter()) {
                let _ = writeln!(text, "  - [{}, {}, {}, {shift}]", row[0], row[1], row[2]);
            }
            let _ = writeln!(text, "  - [0.0, 0.0, 0.0, 1.0]");
        }
        before = (camera.r.transpose(), camera.t);
    }
    let (_folder, path) = file("camchain.yaml", text);
    let found = read(&path);
    let first = &rig.cameras[0];
    lands(&found, &rig, |point| first.rotation * point + first.translation, 1e-6);
    assert_eq!((found.format, found.up), ("YAML", Up::MinusY));
}

#[test]
fn opencv_yaml_of_ours_is_read_back_and_by_opencv_itself() {
    let rig = rig_with_fisheye();
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("opencv.yml");
    write_opencv(&path, &rig, Up::Z).unwrap();
    let read = is_read(&path, &rig, "YAML", ["z", "m"]).rig;
    assert_eq!(read.cameras[1].lens(), rig.cameras[1].lens());

    let Some(python) = python("numpy, cv2") else { return };
    let point = Vector3::new(0.2, 1.1, -0.3);
    let output = python
        .and(&[
            "import cv2, sys, numpy as np",
            "file = cv2.FileStorage(sys.argv[1], cv2.FILE_STORAGE_READ)",
            "names = [file.getNode('names').at(i).string() for i in range(file.getNode('names').size())]",
            "point = np.array(sys.argv[2].split(), float).reshape(1, 1, 3)",
            "for n in names:",
            "    K, R, T = (file.getNode(f'{k}_{n}').mat() for k in ('K', 'R', 'T'))",
            "    d, fish = file.getNode(f'dist_{n}').mat(), file.getNode(f'D_{n}').mat()",
            "    project = cv2.projectPoints if fish is None else cv2.fisheye.projectPoints",
            "    print(*project(point, R, T, K, d if fish is None else fish)[0].ravel())",
        ])
        .arg(&path)
        .arg({
            let p = Up::Z.calibration_from_world() * point;
            format!("{} {} {}", p.x, p.y, p.z)
        })
        .output()
        .unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().count(), 4, "{}", String::from_utf8_lossy(&output.stderr));
    for (line, camera) in text.lines().zip(&rig.cameras) {
        let theirs: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        let ours = camera.project(&point).unwrap();
        assert!((ours.x - theirs[0]).hypot(ours.y - theirs[1]) < 1e-6, "{ours} {theirs:?}");
    }
}

#[test]
fn opencv_xml_of_each_camera_is_read_from_a_folder() {
    let rig = rig_with_fisheye();
    let folder = TempDir::new().unwrap();
    let matrix = |name: &str, rows: usize, numbers: &[f64]| {
        let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
        format!(
            "<{name} type_id=\"opencv-matrix\"><rows>{rows}</rows><cols>{}</cols><dt>d</dt>\
             <data>\n {}</data></{name}>",
            numbers.len() / rows,
            numbers.join(" ")
        )
    };
    for camera in InFile::all(&rig, Up::MinusY, 1e-3) {
        let [width, height] = camera.size;
        let text = format!(
            "<?xml version=\"1.0\"?>\n<opencv_storage>\n<calibration_time>\"Mon\"</calibration_time>\
             <image_width>{width}</image_width><image_height>{height}</image_height>\
             <fisheye_model>{}</fisheye_model>{}{}{}{}</opencv_storage>",
            i32::from(camera.is_fisheye),
            matrix("camera_matrix", 3, camera.k.as_flattened()),
            matrix("distortion_coefficients", camera.lens.len(), &camera.lens),
            matrix("rvec", 3, &camera.rotation_vector()),
            matrix("tvec", 3, &camera.t()),
        );
        fs::write(folder.path().join(format!("{}_calibration.xml", camera.name)), text).unwrap();
    }
    is_read(folder.path(), &rig, "OpenCV XML", ["-y", "mm"]);
}

#[test]
fn xml_of_qualisys_is_read() {
    let rig = rig();
    let mut text = String::from("<?xml version='1.0'?><calibration><cameras>");
    for camera in InFile::all(&rig, Up::Z, 1e-3) {
        let ([width, height], k, lens) = (camera.size, camera.k, &camera.lens);
        // y up, z backwards.
        let axes = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)) * camera.r;
        let axes: String = (0..9)
            .map(|i| format!(" r{}{}=\"{}\"", i / 3 + 1, i % 3 + 1, axes[(i / 3, i % 3)]))
            .collect();
        let at = camera.centre();
        let _ = write!(
            text,
            "<camera active=\"1\" serial=\"{}\" model=\"Miqus Video\" viewrotation=\"0\">\
             <fov_video left=\"0\" top=\"0\" right=\"{}\" bottom=\"{}\"/>\
             <transform x=\"{}\" y=\"{}\" z=\"{}\"{axes}/>\
             <intrinsic focalLengthU=\"{}\" focalLengthV=\"{}\" centerPointU=\"{}\" centerPointV=\"{}\" \
             skew=\"0\" radialDistortion1=\"{}\" radialDistortion2=\"{}\" radialDistortion3=\"{}\" \
             tangentalDistortion1=\"{}\" tangentalDistortion2=\"{}\"/></camera>",
            camera.name,
            width - 1,
            height - 1,
            at.x,
            at.y,
            at.z,
            64.0 * k[0][0],
            64.0 * k[1][1],
            64.0 * k[0][2],
            64.0 * k[1][2],
            lens[0],
            lens[1],
            lens[4],
            lens[2],
            lens[3],
        );
    }
    let text = text + "</cameras></calibration>";
    let (_folder, path) = file("Calib.qca.txt", &text);
    let whole = is_read(&path, &rig, "Qualisys", ["z", "mm"]).rig;
    // Videos of a smaller size; the numbers are those of 1080p.
    let smaller = text.replace(" viewrotation", " video_resolution=\"720p\" viewrotation");
    let (_folder, path) = file("Calib.qca.txt", smaller);
    for (camera, whole) in read(&path).rig.cameras.iter().zip(&whole.cameras) {
        let off = 1.5 * camera.matrix() - whole.matrix();
        assert!(off.fixed_rows::<2>(0).amax() < 1e-9, "{off}");
        assert!((1.5 * f64::from(camera.width) - f64::from(whole.width)).abs() < 1.0);
    }
}

#[test]
fn xml_of_vicon_is_read_with_its_inverse_distortion() {
    // Vicon undoes its distortion with a polynomial in pixels: r (1 + k1 r^2).
    const K1: f64 = 4e-8;
    let mut rig = rig();
    let mut text = String::from("<?xml version=\"1.0\"?><Cameras>");
    for camera in &mut rig.cameras {
        *camera = with_lens(camera, Lens::IDEAL);
        camera.focal.y = camera.focal.x;
    }
    for camera in InFile::all(&rig, Up::Z, 1e-3) {
        let (at, [x, y, z, w]) = (camera.centre(), so3::xyzw_from_rotation(&camera.r));
        let ([width, height], k) = (camera.size, camera.k);
        let _ = write!(
            text,
            "<Camera DEVICEID=\"{}\" SYSTEM=\"DV\" DISPLAY_TYPE=\"Vue\" SENSOR_SIZE=\"{width} {height}\" \
             PIXEL_ASPECT_RATIO=\"1\"><KeyFrames><KeyFrame FOCAL_LENGTH=\"{}\" PRINCIPAL_POINT=\"{} {}\" \
             ORIENTATION=\"{x} {y} {z} {w}\" POSITION=\"{} {} {}\" \
             VICON_RADIAL2=\"ViconRadial2 640 512 {K1} 0 0\" WORLD_ERROR=\"0.1\"/></KeyFrames></Camera>",
            camera.name, k[0][0], k[0][2], k[1][2], at.x, at.y, at.z,
        );
    }
    text += "<Camera DEVICEID=\"7\" SYSTEM=\"Vicon\" SENSOR_SIZE=\"1 1\"><KeyFrames><KeyFrame/></KeyFrames></Camera>";
    let (_folder, path) = file("take.xcp", text + "</Cameras>");
    let whole = std::fs::read_to_string(&path).unwrap();
    for (right, wrong, said) in [
        (
            "FOCAL_LENGTH=\"",
            "FOCAL_LENGTH=\"0\" WAS=\"",
            "FOCAL_LENGTH or PRINCIPAL_POINT is not usable",
        ),
        ("4 0 0\" WORLD", "4 nan 0\" WORLD", "VICON_RADIAL2"),
        (
            "PRINCIPAL_POINT=\"",
            "PRINCIPAL_POINT=\"nan nan\" WAS=\"",
            "FOCAL_LENGTH or PRINCIPAL_POINT",
        ),
    ] {
        assert!(whole.contains(right), "{right}");
        let (_folder, path) = file("wrong.xcp", whole.replacen(right, wrong, 1));
        let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
    let found = read(&path);
    assert_eq!((found.format, found.up, found.unit.metres()), ("Vicon", Up::Z, 1e-3));
    assert_eq!(found.notes, Vec::<String>::new());
    for (read, ideal) in found.rig.cameras.iter().zip(&rig.cameras) {
        for i in 0..20 {
            let point = Vector3::new(0.2 * f64::from(i % 7) - 0.6, 0.1 * f64::from(i), 0.3);
            let seen = read.project(&point).unwrap() - read.centre;
            let undone = seen * (1.0 + K1 * seen.norm_squared()) + read.centre;
            let off = undone - ideal.project(&point).unwrap();
            assert!(off.norm() < 0.01, "{}: {off}", read.name);
            assert!(seen.norm() < 30.0 || (undone - read.centre - seen).norm() > 1e-4);
        }
    }
}

#[test]
fn xml_of_optitrack_is_read_from_utf_16() {
    let rig = rig();
    let mut text = String::from(
        "<?xml version=\"1.0\" encoding=\"UTF-16LE\"?><calibrationProfile version=\"1\"><Calibration><Cameras>",
    );
    for camera in InFile::all(&rig, Up::Y, 1.0) {
        let ([width, height], k, lens, at) = (camera.size, camera.k, &camera.lens, camera.centre());
        // The camera's axes in the world are the columns; y up, z backwards.
        let axes = camera.r.transpose() * Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
        let axes: String =
            (0..9).map(|i| format!(" OrientMatrix{i}=\"{}\"", axes[(i / 3, i % 3)])).collect();
        let inside = format!(
            "LensCenterX=\"{}\" LensCenterY=\"{}\" HorizontalFocalLength=\"{}\" VerticalFocalLength=\"{}\"",
            k[0][2], k[1][2], k[0][0], k[1][1]
        );
        let _ = write!(
            text,
            "<Camera Serial=\"{}\"><Properties CameraID=\"1\"/>\
             <Attributes ImagerPixelWidth=\"{width}\" ImagerPixelHeight=\"{height}\"/>\
             <Intrinsic {inside} k1=\"9\" k2=\"9\" k3=\"9\" TangentialX=\"9\" TangentialY=\"9\"/>\
             <IntrinsicStandardCameraModel {inside} k1=\"{}\" k2=\"{}\" k3=\"{}\" TangentialX=\"{}\" \
             TangentialY=\"{}\"/><Extrinsic X=\"{}\" Y=\"{}\" Z=\"{}\"{axes}/></Camera>",
            camera.name, lens[0], lens[1], lens[4], lens[2], lens[3], at.x, at.y, at.z,
        );
    }
    text += "</Cameras></Calibration></calibrationProfile>";
    let marked = std::iter::once(0xfeff).chain(text.encode_utf16());
    let (_folder, path) = file("take.mcal", marked.flat_map(u16::to_le_bytes).collect::<Vec<_>>());
    is_read(&path, &rig, "OptiTrack", ["y", "m"]);
}

#[test]
fn text_of_colmap_is_read() {
    let rig = rig_with_fisheye();
    let (mut cameras, mut images) = ("# Camera list\n".to_owned(), "# Image list\n\n".to_owned());
    for (i, camera) in InFile::all(&rig, Up::MinusY, 1.0).iter().enumerate() {
        let ([width, height], k, lens) = (camera.size, camera.k, &camera.lens);
        let (model, more) = match camera.is_fisheye {
            true => ("OPENCV_FISHEYE", ""),
            false => ("FULL_OPENCV", "0 0 0"),
        };
        let lens = lens.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let (fx, fy, cx, cy) = (k[0][0], k[1][1], k[0][2] + 0.5, k[1][2] + 0.5);
        let _ = writeln!(cameras, "{i} {model} {width} {height} {fx} {fy} {cx} {cy} {lens} {more}");
        let ([x, y, z, w], [tx, ty, tz]) = (so3::xyzw_from_rotation(&camera.r), camera.t());
        let points = if i == 0 { "" } else { "10.5 20.5 7 30.5 40.5 -1 50.5 60.5 1 70.5 80.5 2" };
        let _ = writeln!(
            images,
            "{i} {w} {x} {y} {z} {tx} {ty} {tz} {i} {}/image 1.png\n{points}",
            camera.name
        );
    }
    let (folder, path) = file("cameras.txt", cameras);
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("belong together, and one is missing"), "{error}");
    fs::write(folder.path().join("images.txt"), images).unwrap();
    for path in [&path, folder.path()] {
        let found = is_read(path, &rig, "COLMAP", ["-y", "m"]);
        assert!(found.notes[0].contains("have no unit"), "{:?}", found.notes);
    }
}

#[test]
fn binaries_and_several_images_of_a_camera_of_colmap_are_said() {
    let (folder, path) = file("cameras.bin", b"\x01\x00");
    for path in [path.as_path(), folder.path()] {
        let error = read_calibration(path, &Convention::default()).unwrap_err().to_string();
        assert!(error.contains("model_converter, output type TXT"), "{error}");
    }
    let (folder, path) = file(
        "cameras.txt",
        "1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 640 480 500 500 320 240\n",
    );
    let images = |x: f64| {
        let image = |id: usize, x: f64, camera: usize, name: &str| {
            format!("{id} 1 0 0 0 {x} 0 3 {camera} {name}\n\n")
        };
        image(1, 0.0, 1, "cam01/0001.png")
            + &image(2, x, 1, "cam01/0002.png")
            + &image(3, 1.0, 2, "cam02/0001.png")
    };
    fs::write(folder.path().join("images.txt"), images(0.0)).unwrap();
    assert_eq!(read(&path).rig.cameras.len(), 2);
    let without_empty_lines = images(0.0).replace("\n\n", "\n");
    fs::write(folder.path().join("images.txt"), without_empty_lines).unwrap();
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("put an empty line after each image"), "{error}");
    let one_folder = images(0.0).replace("cam01/", "images/").replace("cam02/0001", "images/0003");
    fs::write(folder.path().join("images.txt"), one_folder).unwrap();
    let names: Vec<String> =
        read(&path).rig.cameras.into_iter().map(|camera| camera.name).collect();
    assert_eq!(names, ["0001", "0002", "0003"]);
    fs::write(folder.path().join("images.txt"), images(0.5)).unwrap();
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("the images of cam01 have different poses"), "{error}");
}

#[test]
fn yaml_of_a_stereo_pair_of_opencv_is_read() {
    let rig = rig();
    let [first, second] = [0, 1].map(|i| InFile::all(&rig, Up::MinusY, 1.0).swap_remove(i));
    // The pose of the second camera in the first one.
    let (r1, r2) = (&rig.cameras[0], &rig.cameras[1]);
    let turn = r2.rotation * r1.rotation.transpose();
    let along = r2.translation - turn * r1.translation;
    let inside = |camera: &InFile, number: usize| {
        opencv(&format!("M{number}"), 3, camera.k.as_flattened())
            + &opencv(&format!("D{number}"), 1, &camera.lens)
    };
    let intrinsics = format!("%YAML:1.0\n---\n{}{}", inside(&first, 1), inside(&second, 2));
    let none = [0.0; 9];
    let extrinsics = format!(
        "%YAML:1.0\n---\n{}{}{}{}",
        opencv("R", 3, turn.transpose().as_slice()),
        opencv("T", 3, along.as_slice()),
        opencv("R1", 3, &none),
        opencv("R2", 3, &none)
    );
    let (folder, _) = file("intrinsics.yml", intrinsics);
    fs::write(folder.path().join("extrinsics.yml"), extrinsics).unwrap();
    let found = read_calibration(folder.path(), &Up::MinusY.into()).unwrap();
    let [one, other] = &found.rig.cameras[..] else { panic!("{:?}", found.rig) };
    assert_eq!([&*one.name, &*other.name], ["camera1", "camera2"]);
    let between = other.rotation * one.rotation.transpose();
    assert!((between - turn).norm() < 1e-9);
    assert!((other.translation - between * one.translation - along).norm() < 1e-9);
    assert!((other.focal - r2.focal).norm() < 1e-9 && (one.focal - r1.focal).norm() < 1e-9);
}

/// Python with these packages, or `None` and the reason is printed.
struct Python;

fn python(packages: &str) -> Option<Python> {
    let has = Command::new("python3").args(["-c", &format!("import {packages}")]).output();
    if has.is_ok_and(|output| output.status.success()) {
        return Some(Python);
    }
    crate::support::skipped(&format!("python3 with {packages} is not installed"));
    None
}

impl Python {
    fn and(&self, lines: &[&str]) -> Command {
        let mut command = Command::new("python3");
        command.args(["-c", &lines.join("\n")]);
        command
    }
}

#[test]
fn pickles_of_opencap_are_read_and_nothing_in_them_is_run() {
    let Some(python) = python("numpy") else { return };
    let mut rig = rig();
    for (i, camera) in rig.cameras.iter_mut().enumerate() {
        camera.name = format!("Cam{i}");
    }
    let camera = |camera: InFile| {
        json!({ "name": camera.name, "size": camera.size, "K": camera.k, "d": [camera.lens],
            "R": camera.r(), "t": camera.t() })
    };
    let cameras: Vec<Value> = InFile::all(&rig, Up::MinusY, 1e-3).into_iter().map(camera).collect();
    let mut whole = Vec::new();
    for protocol in 2..=5 {
        let folder = TempDir::new().unwrap();
        let output = python
            .and(&[
                "import json, numpy as np, os, pickle, sys",
                "for camera in json.loads(sys.argv[2]):",
                "    place = os.path.join(sys.argv[1], camera['name'])",
                "    os.mkdir(place)",
                "    width, height = camera['size']",
                "    fields = {'distortion': np.array(camera['d']), 'intrinsicMat': np.array(camera['K']),",
                "        'imageSize': np.array([[height], [width]], dtype=float),",
                "        'rotation': np.asfortranarray(camera['R']),",
                "        'translation': np.array(camera['t']).reshape(3, 1),",
                "        'rotation_EulerAngles': np.float64(1.5), 'count': 3, 'ok': True, 'all': (1, 'a', None)}",
                "    with open(os.path.join(place, 'cameraIntrinsicsExtrinsics.pickle'), 'wb') as file:",
                "        pickle.dump(fields, file, protocol=int(sys.argv[3]))",
            ])
            .arg(folder.path())
            .arg(Value::from(cameras.clone()).to_string())
            .arg(protocol.to_string())
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        is_read(folder.path(), &rig, "pickle", ["-y", "mm"]);
        whole = fs::read(folder.path().join("Cam0/cameraIntrinsicsExtrinsics.pickle")).unwrap();
    }
    let (folder, path) =
        file("bad.pickle", b"\x80\x04cos\nsystem\n(X\x0b\x00\x00\x00touch nevertR.");
    let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
    assert!(error.contains("os.system is neither a plain value nor a numpy array"), "{error}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    // What would take all memory or the whole stack is refused.
    let nested = [b"\x80\x04]".to_vec(), b"\x85".repeat(100_000), b".".to_vec()].concat();
    let doubled =
        [b"\x80\x04]\x94".to_vec(), b"h\x00h\x00\x86q\x00".repeat(60), b".".to_vec()].concat();
    for bytes in [nested, doubled] {
        let (_folder, path) = file("large.pickle", bytes);
        let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
        assert!(error.contains("it holds too m"), "{error}");
    }
    for part in [2, 9, 60, 200, whole.len() - 1] {
        let (_folder, path) = file("part.pickle", &whole[..part]);
        let error = read_calibration(&path, &Convention::default()).unwrap_err().to_string();
        assert!(error.contains("cut"), "{part}: {error}");
    }
}

#[test]
fn poses_the_other_way_round_are_turned_with_a_note() {
    let rig = rig();
    let opengl = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
    type Written = fn(&Matrix3<f64>, &Vector3<f64>) -> (Matrix3<f64>, Vector3<f64>);
    let ways: [(&str, Written); 3] = [
        ("the poses of the cameras in the world", |r, t| (r.transpose(), -(r.transpose() * t))),
        ("transposed rotations", |r, t| (r.transpose(), *t)),
        ("transposed rotations about the right places", |r, t| {
            (r.transpose(), r.transpose() * r.transpose() * t)
        }),
    ];
    for (what, written) in ways {
        let mut cameras = InFile::all(&rig, Up::Z, 1.0);
        for camera in &mut cameras {
            (camera.r, camera.t) = written(&camera.r, &camera.t);
        }
        let (_folder, path) = file("Calib.toml", pose2sim(&cameras));
        let found = is_read(&path, &rig, "TOML", ["z", "m"]);
        assert!(found.notes[0].contains(what), "{:?}", found.notes);
    }
    let mut cameras = InFile::all(&rig, Up::Z, 1.0);
    for camera in &mut cameras {
        (camera.r, camera.t) = (opengl * camera.r, opengl * camera.t);
    }
    let (_folder, path) = file("Calib.toml", pose2sim(&cameras));
    let found = is_read(&path, &rig, "TOML", ["z", "m"]);
    assert!(found.notes[0].contains("look along -z"), "{:?}", found.notes);
}

#[test]
fn cameras_beside_and_opposite_each_other_are_read_as_they_are() {
    let ring = ring_rig(12, 4.0, 1.6).unwrap();
    // Within 60 degrees, within 30, and two that face each other.
    for chosen in [&[0, 1, 2][..], &[0, 1], &[0, 6]] {
        let mut rig = ring.clone();
        rig.cameras = chosen.iter().map(|&i| ring.cameras[i].clone()).collect();
        for (up, said, unit) in WORLDS {
            let (_folder, path) = file("Calib.toml", pose2sim(&InFile::all(&rig, up, unit)));
            let found = is_read(&path, &rig, "TOML", said);
            assert!(found.notes.is_empty(), "{:?}", found.notes);
        }
    }
}

#[test]
fn a_unit_and_an_axis_that_are_given_are_used_and_doubted() {
    let rig = rig();
    let (_folder, path) = file("Calib.toml", pose2sim(&InFile::all(&rig, Up::Z, 1e-3)));
    let given = Convention { unit: "m".parse().unwrap(), ..Up::Y.into() };
    let found = read_calibration(&path, &given).unwrap();
    assert_eq!((found.up, found.unit.metres()), (Up::Y, 1.0));
    assert!(found.notes[0].contains("m from what they look at"), "{:?}", found.notes);
    let feet = Convention { unit: "ft".parse().unwrap(), ..Convention::default() };
    assert_eq!(read_calibration(&path, &feet).unwrap().unit.metres(), 0.3048);
    for wrong in ["yards", "0", "-1", "nan"] {
        assert!(
            wrong
                .parse::<bundlemocap::io::formats::Auto<bundlemocap::io::formats::Unit>>()
                .is_err()
        );
    }
}
