//! The decoder on the solver's way, in f32, against that of poses, in f64.

use bundlemocap::body::{Posture, Skeleton, forward};
use bundlemocap::manifold::{Decoder, Jacobians, Keyframe, Latent};
use nalgebra::{Matrix3, Vector3};

#[test]
fn on_the_solvers_way_joints_are_right_to_micrometres() {
    let decoder = Decoder::embedded().unwrap();
    let codes: Vec<Latent> = (0..500)
        .map(|k| {
            std::array::from_fn(|i| 1.5 * ((i + 1) as f64 * (0.31 + 0.017 * f64::from(k))).sin())
        })
        .collect();
    let mut work = Jacobians::default();
    decoder.values(&codes, &mut work);
    let skeleton = Skeleton::default();
    let posture =
        |local| -> Posture { forward(&skeleton, &Matrix3::identity(), &Vector3::zeros(), &local) };
    let mut worst = 0.0_f64;
    for (k, z) in codes.iter().enumerate() {
        let (way, pose) = (posture(work.rotations(k)), posture(decoder.decode(z)));
        let apart = way.positions.iter().zip(&pose.positions).map(|(a, b)| (a - b).norm());
        worst = apart.fold(worst, f64::max);
    }
    println!("joints are at most {:.2} um apart", 1e6 * worst);
    assert!(0.0 < worst && worst < 2e-6, "{worst} m");
}

/// Poses do not depend on what else is decoded with them, as published ones must not.
#[test]
fn a_pose_is_the_same_whatever_is_decoded_with_it() {
    let decoder = Decoder::embedded().unwrap();
    let keyframe = |k: usize| Keyframe {
        z: std::array::from_fn(|i| ((i + 2 * k) as f64 * 0.7).sin()),
        root_rotation: Matrix3::identity(),
        root_position: Vector3::zeros(),
    };
    let keyframes: Vec<_> = (0..13).map(keyframe).collect();
    let together = decoder.poses(&keyframes);
    for (keyframe, pose) in keyframes.iter().zip(&together) {
        let alone = decoder.pose(keyframe);
        let apart = alone.local.iter().zip(&pose.local).map(|(a, b)| (a - b).amax());
        assert!(apart.fold(0.0, f64::max) < 1e-14);
    }
}
