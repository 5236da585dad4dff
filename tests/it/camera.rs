//! Projection, distortion, rigs and triangulation.

use bundlemocap::core::camera::{
    Camera, CameraError, Lens, Rig, View, triangulate, triangulate_dropping, triangulate_robust,
};
use bundlemocap::core::so3;
use nalgebra::{DMatrix, Matrix2, Matrix3, Vector2, Vector3};

use crate::jacobians::{assert_jacobian, numeric_jacobian};

fn lenses() -> [(&'static str, Lens); 5] {
    [
        ("ideal", Lens::IDEAL),
        ("brown 4", Lens::brown_conrady(&[-0.05, 0.14, 6e-4, 7e-4]).unwrap()),
        ("brown 5", Lens::brown_conrady(&[-0.2, 0.25, -1e-3, 1e-3, -0.01]).unwrap()),
        ("brown 8", Lens::brown_conrady(&[0.4, -0.2, 1e-3, -2e-3, 0.05, 0.5, -0.1, 0.02]).unwrap()),
        ("fisheye", Lens::fisheye(&[-0.03, 0.01, -0.004, 0.0005]).unwrap()),
    ]
}

fn matrix() -> Matrix3<f64> {
    Matrix3::new(1681.2, 0.7, 533.0, 0.0, 1679.5, 948.1, 0.0, 0.0, 1.0)
}

/// Looks at the world's (0, 1, 0) from `distance` metres at `angle` around the y axis.
fn camera_around(name: &str, angle: f64, distance: f64, lens: Lens) -> Camera {
    let centre = Vector3::new(distance * angle.sin(), 1.4, distance * angle.cos());
    let forward = (Vector3::new(0.0, 1.0, 0.0) - centre).normalize();
    let right = forward.cross(&Vector3::y()).normalize();
    let down = forward.cross(&right);
    let rotation = Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
    Camera::new(name, [1088, 1920], &matrix(), lens, rotation, -rotation * centre).unwrap()
}

fn ring(count: usize) -> Rig {
    let lens = lenses()[1].1;
    let camera = |i: usize| {
        let angle = i as f64 * std::f64::consts::TAU / count as f64;
        camera_around(&format!("cam{i}"), angle, 4.0, lens)
    };
    Rig::new(1, (0..count).map(camera).collect()).unwrap()
}

fn views_of(rig: &Rig, point: &Vector3<f64>) -> Vec<View> {
    rig.cameras.iter().enumerate().map(|(i, c)| (i, c.project(point).unwrap(), 0.8)).collect()
}

#[test]
fn jacobians_of_projection_match_central_differences() {
    for (name, lens) in lenses() {
        let camera = camera_around("a", 0.4, 3.0, lens);
        for p in [[0.0, 1.0, 0.0], [0.4, 1.6, -0.3], [-0.5, 0.2, 0.2], [0.31, 0.4, 0.9]] {
            let (pixel, jacobian) = camera.project_with_jacobian(&Vector3::from(p)).unwrap();
            assert_eq!(Some(pixel), camera.project(&Vector3::from(p)), "{name}");
            let numeric = numeric_jacobian(&p, 1e-4, |x| {
                let at = Vector3::from_column_slice(x);
                camera.project(&at).unwrap().as_slice().to_vec()
            });
            let jacobian = DMatrix::from_fn(2, 3, |r, c| jacobian[(r, c)]);
            assert_jacobian(&jacobian, &numeric, 1e-9);
        }
    }
}

#[test]
fn jacobians_of_distortion_match_central_differences() {
    for (name, lens) in lenses() {
        for n in [[0.0, 0.0], [1e-5, -2e-5], [1e-4, 1e-4], [0.3, -0.1], [-0.4, 0.6]] {
            let (distorted, jacobian) = lens.distort_with_jacobian(&n.into());
            assert!((distorted - lens.distort(&n.into())).norm() < 1e-15, "{name}");
            let numeric = numeric_jacobian(&n, 1e-4, |x| {
                lens.distort(&Vector2::new(x[0], x[1])).as_slice().to_vec()
            });
            let jacobian = DMatrix::from_fn(2, 2, |r, c| jacobian[(r, c)]);
            assert_jacobian(&jacobian, &numeric, 1e-9);
        }
    }
}

#[test]
fn projection_of_a_known_point_agrees_with_the_formula_by_hand() {
    let lens = Lens::brown_conrady(&[0.1, 0.02, 0.01, -0.02, 0.003]).unwrap();
    let k = Matrix3::new(1000.0, 0.0, 320.0, 0.0, 900.0, 240.0, 0.0, 0.0, 1.0);
    let camera =
        Camera::new("a", [640, 480], &k, lens, Matrix3::identity(), Vector3::zeros()).unwrap();
    let (x, y): (f64, f64) = (0.2, -0.3);
    let r2 = x * x + y * y;
    let g = 1.0 + 0.1 * r2 + 0.02 * r2 * r2 + 0.003 * r2.powi(3);
    let u = x * g + 2.0 * 0.01 * x * y - 0.02 * (r2 + 2.0 * x * x);
    let v = y * g + 0.01 * (r2 + 2.0 * y * y) - 2.0 * 0.02 * x * y;
    let pixel = camera.project(&Vector3::new(0.4, -0.6, 2.0)).unwrap();
    assert!((pixel - Vector2::new(320.0 + 1000.0 * u, 240.0 + 900.0 * v)).norm() < 1e-9);
}

#[test]
fn undistortion_inverts_projection_over_the_whole_image() {
    for (name, lens) in lenses() {
        let camera = camera_around("a", 0.4, 3.0, lens);
        for u in (0..1088).step_by(64) {
            for v in (0..1920).step_by(64) {
                let pixel = Vector2::new(f64::from(u), f64::from(v));
                let ray = camera.ray(&pixel).expect(name);
                let point = camera.centre_in_world() + ray * 2.5;
                let back = camera.project(&point).expect(name);
                assert!((back - pixel).norm() < 1e-6, "{name}: {pixel} {back}");
            }
        }
    }
}

#[test]
fn a_wide_fisheye_round_trips_close_to_the_camera_plane() {
    let lens = Lens::fisheye(&[-0.01, 0.002, 0.0, 0.0]).unwrap();
    for degrees in [0.0, 1e-9, 1.0, 30.0, 60.0, 80.0, 88.0] {
        let n = Vector2::new(0.6, -0.8) * f64::to_radians(degrees).tan();
        let back = lens.undistort(&lens.distort(&n), lens.limit()).unwrap();
        assert!((back - n).norm() < 1e-8 * (1.0 + n.norm_squared()), "{degrees}");
    }
    assert_eq!(lens.undistort(&Vector2::new(3.0, 0.0), lens.limit()), None);
}

#[test]
fn nothing_is_projected_from_behind_or_from_beyond_a_fold() {
    let folding = Lens::brown_conrady(&[-0.3, 0.0, 0.0, 0.0]).unwrap();
    let fold = (1.0_f64 / 0.9).sqrt();
    assert!((folding.limit() - fold).abs() < 1e-9);
    assert_eq!(Lens::IDEAL.limit(), f64::INFINITY);
    let k = matrix();
    let camera =
        Camera::new("a", [64, 64], &k, folding, Matrix3::identity(), Vector3::zeros()).unwrap();
    let at = |x: f64, z: f64| Vector3::new(x, 0.0, z);
    assert!(camera.project(&at(fold - 0.01, 1.0)).is_some());
    for p in [at(fold + 0.01, 1.0), at(2.5, 1.0), at(0.1, -1.0), at(0.1, 0.0), at(f64::NAN, 1.0)] {
        assert_eq!(camera.project(&p), None, "{p}");
        assert_eq!(camera.project_with_jacobian(&p), None, "{p}");
    }
    let beyond = folding.distort(&Vector2::new(fold, 0.0)).x + 0.01;
    assert_eq!(folding.undistort(&Vector2::new(beyond, 0.0), folding.limit()), None);
}

#[test]
fn a_tangential_fold_is_a_limit_too() {
    let lens = Lens::brown_conrady(&[0.0, 0.0, 0.1, 0.0]).unwrap();
    let limit = lens.limit();
    assert!(limit.is_finite());
    let jacobian: Matrix2<f64> = lens.distort_with_jacobian(&Vector2::new(0.0, -limit)).1;
    assert!(jacobian.determinant().abs() < 1e-6, "{jacobian}");
}

#[test]
fn the_ray_starts_at_the_centre_and_the_depth_is_along_the_axis() {
    let camera = camera_around("a", 1.0, 3.0, Lens::IDEAL);
    let principal = camera.ray(&camera.centre).unwrap();
    let on_axis = camera.centre_in_world() + principal * 2.0;
    assert!((camera.depth(&on_axis) - 2.0).abs() < 1e-12);
    assert!((camera.matrix() - matrix()).amax() < 1e-12);
}

#[test]
fn bad_cameras_and_rigs_are_refused_with_their_names() {
    let good = (matrix(), Lens::IDEAL, Matrix3::identity(), Vector3::zeros());
    let make = |k: Matrix3<f64>, lens, r, t| Camera::new("left", [10, 10], &k, lens, r, t);
    let mut singular = good.0;
    singular[(1, 1)] = 0.0;
    let error = make(singular, good.1, good.2, good.3).unwrap_err();
    assert!(matches!(error, CameraError::SingularIntrinsics { fy: 0.0, .. }), "{error}");
    assert!(error.to_string().contains("camera left"));
    let mirrored = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    for r in [mirrored, Matrix3::identity() * 1.01, Matrix3::zeros()] {
        let error = make(good.0, good.1, r, good.3).unwrap_err();
        assert!(matches!(error, CameraError::NotARotation { .. }), "{error}");
    }
    let nan = Vector3::new(0.0, f64::NAN, 0.0);
    let error = make(good.0, good.1, good.2, nan).unwrap_err();
    assert!(matches!(error, CameraError::NotFinite { field: "the translation", .. }), "{error}");
    let error = make(good.0, Lens::BrownConrady([f64::NAN; 8]), good.2, good.3).unwrap_err();
    assert!(matches!(error, CameraError::NotFinite { field: "the distortion", .. }), "{error}");
    let empty = Camera::new("left", [10, 0], &good.0, good.1, good.2, good.3).unwrap_err();
    assert!(matches!(empty, CameraError::EmptyImage { height: 0, .. }), "{empty}");
    assert!(Lens::brown_conrady(&[0.0; 3]).is_err());
    assert!(Lens::brown_conrady(&[0.1; 12]).is_err());
    assert_eq!(Lens::brown_conrady(&[0.0; 14]).unwrap(), Lens::IDEAL);
    assert!(Lens::fisheye(&[0.1; 5]).is_err());

    let one = camera_around("a", 0.0, 3.0, Lens::IDEAL);
    let few = Rig::new(1, vec![one.clone()]).unwrap_err();
    assert_eq!(few, CameraError::TooFewCameras { found: 1 });
    let twice = Rig::new(1, vec![one.clone(), one]).unwrap_err();
    assert_eq!(twice, CameraError::DuplicateName { name: "a".into() });
    assert_eq!(ring(3).index_of("cam2"), Some(2));
    assert_eq!(ring(3).index_of("cam3"), None);
}

#[test]
fn a_rounded_rotation_is_orthonormalised() {
    let exact = so3::exp(&Vector3::new(0.3, -1.2, 0.4));
    let rounded = exact.map(|v| (v * 1e4).round() / 1e4);
    let camera =
        Camera::new("a", [10, 10], &matrix(), Lens::IDEAL, rounded, Vector3::zeros()).unwrap();
    assert!(so3::is_rotation(&camera.rotation, 1e-12));
    assert!(so3::angle_between(&camera.rotation, &exact) < 1e-3);
}

#[test]
fn triangulation_is_exact_on_clean_views() {
    for count in [2, 3, 4, 9] {
        let rig = if count == 2 { ring(5) } else { ring(count) };
        let point = Vector3::new(0.2, 1.3, -0.4);
        let views = &views_of(&rig, &point)[..count];
        assert!((triangulate(&rig, views).unwrap() - point).norm() < 1e-9, "{count}");
        let found = triangulate_robust(&rig, views, 5.0, 1).unwrap();
        assert!((found.point - point).norm() < 1e-9, "{count}");
        assert!(found.residual_px < 1e-6);
        assert_eq!(found.inliers, (0..count).collect::<Vec<_>>());
    }
}

#[test]
fn robust_triangulation_rejects_wrong_views() {
    let point = Vector3::new(-0.3, 0.7, 0.2);
    let rig = ring(5);
    let mut views = views_of(&rig, &point);
    views[3].1 += Vector2::new(150.0, -90.0);
    assert!((triangulate(&rig, &views).unwrap() - point).norm() > 0.01);
    let found = triangulate_robust(&rig, &views, 10.0, 1).unwrap();
    assert_eq!(found.inliers, [0, 1, 2, 4]);
    assert!((found.point - point).norm() < 1e-9);
}

#[test]
fn many_views_are_sampled_by_the_seed() {
    let point = Vector3::new(0.1, 1.1, 0.1);
    let rig = ring(21);
    let mut views = views_of(&rig, &point);
    for (i, view) in views.iter_mut().enumerate().take(8) {
        view.1 += Vector2::new(80.0 + 10.0 * i as f64, 50.0);
    }
    let found = triangulate_robust(&rig, &views, 10.0, 3).unwrap();
    assert_eq!(found.inliers, (8..21).collect::<Vec<_>>());
    assert_eq!(triangulate_robust(&rig, &views, 10.0, 3), Some(found));
}

#[test]
fn parallel_rays_single_views_and_points_behind_are_refused() {
    let near = camera_around("a", 0.0, 4.0, Lens::IDEAL);
    let beside = camera_around("b", 0.001, 4.0, Lens::IDEAL);
    let rig = Rig::new(1, vec![near, beside]).unwrap();
    let views = views_of(&rig, &Vector3::new(0.0, 1.0, 0.0));
    assert_eq!(triangulate(&rig, &views), None);
    assert_eq!(triangulate_robust(&rig, &views, 10.0, 1), None);

    let rig = ring(4);
    let views = views_of(&rig, &Vector3::new(0.0, 1.0, 0.0));
    assert_eq!(triangulate_robust(&rig, &views[..1], 10.0, 1), None);
    assert_eq!(triangulate_robust(&rig, &[], 10.0, 1), None);
    assert_eq!(triangulate(&rig, &[(9, Vector2::zeros(), 1.0), views[0]]), None);
    let unknown = [(9, Vector2::zeros(), 1.0), views[0], views[1]];
    assert_eq!(triangulate_dropping(&rig, &unknown, 5.0, 2).unwrap().1, [1, 2]);

    // The rays of two neighbours that diverge in front of the cameras meet behind them.
    let pixel = |dx: f64| rig.cameras[0].centre + Vector2::new(dx, 0.0);
    let apart =
        [(0, pixel(0.0), 1.0), (1, rig.cameras[1].centre + Vector2::new(-6000.0, 0.0), 1.0)];
    assert_eq!(triangulate(&rig, &apart), None);
}
