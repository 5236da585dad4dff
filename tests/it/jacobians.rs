//! Every Jacobian against central differences, with one helper.

use bundlemocap::core::body::{
    Attachment, BODY_JOINTS, SHAPE_COEFFICIENTS, Shape, Skeleton, Tangents, forward, push_forward,
};
use bundlemocap::core::detections::Keypoint;
use bundlemocap::core::manifold::{Decoder, Interpolation, Jacobians, LATENT, Latent};
use bundlemocap::core::so3;
use nalgebra::{DMatrix, Matrix3, Vector3};

use crate::manifold::decoded;

/// Central differences of fourth order of `f` at `x`: columns are the derivatives by each entry.
/// The decoder has six digits, so a step through it must be some hundredths long.
pub fn numeric_jacobian(x: &[f64], step: f64, f: impl Fn(&[f64]) -> Vec<f64>) -> DMatrix<f64> {
    let columns: Vec<_> = (0..x.len())
        .map(|i| {
            let at = |steps: f64| {
                let mut moved = x.to_vec();
                moved[i] += steps * step;
                nalgebra::DVector::from_vec(f(&moved))
            };
            ((at(1.0) - at(-1.0)) * 8.0 - at(2.0) + at(-2.0)) / (12.0 * step)
        })
        .collect();
    DMatrix::from_columns(&columns)
}

/// Accepts if every entry differs by at most `tolerance` times the largest entry (at least 1).
pub fn assert_jacobian(analytic: &DMatrix<f64>, numeric: &DMatrix<f64>, tolerance: f64) {
    assert_eq!(analytic.shape(), numeric.shape());
    let worst = (analytic - numeric).amax();
    let allowed = tolerance * numeric.amax().max(1.0);
    assert!(worst <= allowed, "worst difference {worst:.3e}, allowed {allowed:.3e}");
}

fn wave(i: usize, seed: f64) -> f64 {
    ((i as f64 + 1.0) * seed).sin()
}

fn code(seed: f64) -> Latent {
    std::array::from_fn(|i| wave(i, seed))
}

fn wide(rows: usize, columns: usize, row_major: &[f32]) -> DMatrix<f64> {
    DMatrix::from_row_slice(rows, columns, row_major).cast()
}

fn dense(m: &Matrix3<f64>) -> DMatrix<f64> {
    DMatrix::from_iterator(3, 3, m.iter().copied())
}

#[test]
fn left_and_right_jacobians_of_the_exponential() {
    let v = Vector3::new(0.4, -1.1, 0.7);
    let left = numeric_jacobian(v.as_slice(), 1e-6, |x| {
        let moved = so3::exp(&Vector3::from_column_slice(x));
        so3::log(&(moved * so3::exp(&v).transpose())).as_slice().to_vec()
    });
    assert_jacobian(&dense(&so3::left_jacobian(&v)), &left, 1e-7);
    let inverse = so3::right_jacobian(&v) * so3::right_jacobian_inverse(&v);
    assert!((inverse - Matrix3::identity()).amax() < 1e-12);
}

#[test]
fn rotation_slerp_by_its_end() {
    let a = so3::exp(&Vector3::new(0.4, -1.1, 0.7));
    for far in [0.01, 0.9, 2.9] {
        let b = a * so3::exp(&(Vector3::new(0.3, 0.5, -0.8).normalize() * far));
        let at = so3::slerp(&a, &b, 0.3);
        let numeric = numeric_jacobian(&[0.0; 3], 1e-6, |w| {
            let turned = so3::exp(&Vector3::from_column_slice(w)) * b;
            so3::log(&(so3::slerp(&a, &turned, 0.3) * at.transpose())).as_slice().to_vec()
        });
        assert_jacobian(&dense(&so3::slerp_jacobian(&a, &b, 0.3)), &numeric, 1e-6);
    }
}

#[test]
fn latent_slerp_by_both_ends_at_every_angle() {
    let z0 = code(0.7);
    let near = |d: f64| std::array::from_fn(|i| z0[i] * 1.2 + d * wave(i, 2.1));
    let opposite: Latent = std::array::from_fn(|i| -z0[i] + 0.01 * wave(i, 2.1));
    for z1 in [code(1.3), near(1e-2), near(1e-7), opposite] {
        for s in [0.2, 1.0, 1.02] {
            let analytic = |a: &Latent, b: &Latent, s| {
                let t = Interpolation::Slerp.tangent(a, b, s);
                DMatrix::from_fn(LATENT, LATENT, |i, j| {
                    t.across[i] * t.along[j] + if i == j { t.scale } else { 0.0 }
                })
            };
            let by_end = numeric_jacobian(&z1, 1e-7, |x| {
                let x: Latent = x.try_into().unwrap();
                Interpolation::Slerp.latent(&z0, &x, s).to_vec()
            });
            assert_jacobian(&analytic(&z0, &z1, s), &by_end, 1e-5);
            let by_start = numeric_jacobian(&z0, 1e-7, |x| {
                let x: Latent = x.try_into().unwrap();
                Interpolation::Slerp.latent(&x, &z1, s).to_vec()
            });
            assert_jacobian(&analytic(&z1, &z0, 1.0 - s), &by_start, 1e-5);
        }
    }
}

#[test]
fn decoded_rotations_by_the_code() {
    let decoder = Decoder::embedded().unwrap();
    let codes = [code(0.7), code(1.9)];
    let mut work = Jacobians::default();
    decoder.values(&codes, &mut work);
    decoder.tangents(&mut work);
    for (n, z) in codes.iter().enumerate() {
        let mut analytic = vec![0.0; 3 * BODY_JOINTS * LATENT];
        work.local_tangents(n, &mut analytic);
        let analytic = wide(3 * BODY_JOINTS, LATENT, &analytic);
        let at = decoded(z);
        let numeric = numeric_jacobian(z, 1e-3, |x| {
            let moved = decoded(&x.try_into().unwrap());
            let turn = |j: usize| so3::log(&(at[j].transpose() * moved[j]));
            (0..BODY_JOINTS).flat_map(|j| turn(j).as_slice().to_vec()).collect()
        });
        assert_jacobian(&analytic, &numeric, 1e-5);
    }
}

#[test]
fn joints_and_points_by_rotations_root_and_shape() {
    let shape = Shape(std::array::from_fn(|i| wave(i, 0.9)));
    let root = so3::exp(&Vector3::new(0.2, 0.9, -0.4));
    let base = Vector3::new(0.5, 1.0, -2.0);
    let local: [Matrix3<f64>; BODY_JOINTS] =
        std::array::from_fn(|j| so3::exp(&Vector3::new(wave(j, 0.3), wave(j, 0.5), wave(j, 0.8))));
    let locals = 3 * BODY_JOINTS;
    let n = locals + 6 + SHAPE_COEFFICIENTS;
    let offset = Vector3::new(0.03, -0.1, 0.07);

    let point = |x: &[f64], at: &Attachment| {
        let turned: [Matrix3<f64>; BODY_JOINTS] = std::array::from_fn(|j| {
            local[j] * so3::exp(&Vector3::from_column_slice(&x[3 * j..3 * j + 3]))
        });
        let root = so3::exp(&Vector3::from_column_slice(&x[locals..locals + 3])) * root;
        let position = base + Vector3::from_column_slice(&x[locals + 3..locals + 6]);
        let shape = Shape(std::array::from_fn(|i| shape.0[i] + x[locals + 6 + i]));
        let posture = forward(&Skeleton::new(shape), &root, &position, &turned);
        posture.positions[at.joint.index()] + at.turn(&posture) * offset
    };

    let skeleton = Skeleton::new(shape);
    let posture = forward(&skeleton, &root, &base, &local);
    let identity = DMatrix::<f32>::identity(locals, locals);
    let mut tangents = Tangents::zeros(n);
    tangents.set_root_rotation(locals, &Matrix3::identity());
    tangents.set_root_position(locals + 3, 1.0);
    push_forward(&skeleton, &posture, identity.as_slice(), locals, Some(locals + 6), &mut tangents);
    // Of their own joint; with their joint and its parent.
    for keypoint in
        [Keypoint::LBigToe, Keypoint::Nose, Keypoint::RWrist, Keypoint::LHip, Keypoint::RKnee]
    {
        let at = Attachment::of(keypoint);
        let mut rows = vec![0.0; 3 * n];
        let arms = at.arms(&posture, &offset);
        for (axis, row) in rows.chunks_exact_mut(n).enumerate() {
            tangents.along(&arms, &Vector3::ith(axis, 1.0), row);
        }
        let numeric = numeric_jacobian(&vec![0.0; n], 1e-6, |x| point(x, &at).as_slice().to_vec());
        assert_jacobian(&wide(3, n, &rows), &numeric, 1e-6);
    }
}

#[cfg(feature = "research")]
#[test]
fn transition_residuals_by_three_keyframes() {
    use bundlemocap::core::manifold::Keyframe;
    use bundlemocap::research::transition::{MOVE, THREE, Transition, TransitionWork, state_of};
    let transition = Transition::embedded().unwrap();
    let mut work = TransitionWork::default();
    let step = 0.02;
    let per = LATENT + 6;
    let keyframes: [Keyframe; 3] = std::array::from_fn(|k| Keyframe {
        z: std::array::from_fn(|i| wave(i, 0.7) + 0.05 * k as f64 * wave(i, 1.3)),
        root_rotation: so3::exp(&Vector3::new(0.2 + 0.03 * k as f64, 0.9, -0.4 * k as f64)),
        root_position: Vector3::new(0.5, 1.0 - 0.01 * k as f64, 0.02 * (k * k) as f64),
        correction: Default::default(),
    });
    let of = |k: &[Keyframe; 3]| [k[0].clone(), k[1].clone(), k[2].clone()];
    let [a, b, c] = &keyframes;
    let (_, deviation) = transition.predict(&state_of(a, b, step), &mut work);
    let mut analytic = vec![0.0; MOVE * THREE];
    transition.residual_with_tangent([a, b, c], step, &deviation, &mut work, &mut analytic);
    let numeric = numeric_jacobian(&[0.0; THREE], 1e-4, |x| {
        let mut moved = of(&keyframes);
        for (keyframe, x) in moved.iter_mut().zip(x.chunks_exact(per)) {
            keyframe.z.iter_mut().zip(x).for_each(|(z, x)| *z += x);
            let turn = so3::exp(&Vector3::from_column_slice(&x[LATENT..LATENT + 3]));
            keyframe.root_rotation = turn * keyframe.root_rotation;
            keyframe.root_position += Vector3::from_column_slice(&x[LATENT + 3..]);
        }
        let [a, b, c] = &moved;
        let mut work = TransitionWork::default();
        transition.residual([a, b, c], step, &deviation, &mut work).to_vec()
    });
    assert_jacobian(&DMatrix::from_row_slice(MOVE, THREE, &analytic), &numeric, 1e-5);
}
