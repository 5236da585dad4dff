//! The decoder against a simple implementation in f64.

use bundlemocap::core::body::{BODY_JOINTS, Posture, Skeleton, forward};
use bundlemocap::core::manifold::{Decoder, EMBEDDED, Jacobians, Keyframe, Latent};
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use safetensors::SafeTensors;

/// The output of the shipped weights for a code, by their definition.
pub fn decoded(z: &Latent) -> [Matrix3<f64>; BODY_JOINTS] {
    let tensors = SafeTensors::deserialize(EMBEDDED).unwrap();
    let numbers = |name: String| -> Option<DVector<f64>> {
        let bytes = tensors.tensor(&name).ok()?.data().chunks_exact(4);
        let number = |four: &[u8]| f64::from(f32::from_le_bytes(four.try_into().unwrap()));
        Some(DVector::from_vec(bytes.map(number).collect()))
    };
    let mut values = DVector::from_column_slice(z);
    for layer in 0.. {
        let named = |what| numbers(format!("decoder.{layer}.{what}"));
        let (Some(weight), Some(bias)) = (named("weight"), named("bias")) else { break };
        if layer > 0 {
            values.apply(|v| *v /= 1.0 + (-*v).exp());
        }
        let weight = DMatrix::from_row_slice(bias.len(), values.len(), weight.as_slice());
        values = weight * values + bias;
    }
    std::array::from_fn(|joint| {
        let [a, b] = [0, 3].map(|at| values.fixed_rows::<3>(6 * joint + at).into_owned());
        let first = a.normalize();
        let second = (b - first * first.dot(&b)).normalize();
        Matrix3::from_columns(&[first, second, first.cross(&second)])
    })
}

#[test]
fn joints_are_accurate_to_micrometres() {
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
        let (ours, exact) = (posture(work.rotations(k)), posture(decoded(z)));
        let apart = ours.positions.iter().zip(&exact.positions).map(|(a, b)| (a - b).norm());
        worst = apart.fold(worst, f64::max);
    }
    println!("joints are at most {:.2} um apart", 1e6 * worst);
    assert!(0.0 < worst && worst < 2e-6, "{worst} m");
}

/// Poses do not depend on the other codes of a batch; published ones must not.
#[test]
fn a_pose_does_not_depend_on_its_batch() {
    let decoder = Decoder::embedded().unwrap();
    let keyframe = |k: usize| Keyframe {
        z: std::array::from_fn(|i| ((i + 2 * k) as f64 * 0.7).sin()),
        root_rotation: Matrix3::identity(),
        root_position: Vector3::zeros(),
        correction: Default::default(),
    };
    let keyframes: Vec<_> = (0..13).map(keyframe).collect();
    let together = decoder.poses(&keyframes);
    for (keyframe, pose) in keyframes.iter().zip(&together) {
        let alone = decoder.pose(keyframe);
        assert_eq!(alone.local, pose.local);
    }
}
