//! Cameras: projection, distortion, rigs, triangulation.
//!
//! Frames: `world` is right-handed, metres, y up; `camera` is OpenCV's, x right, y down, z into
//! the scene. Normalised coordinates are (x / z, y / z) of a point in the camera frame. Pixels
//! have their centres at whole numbers, as in OpenCV.

mod lens;
mod rig;
mod triangulate;

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

pub use lens::Lens;
pub use rig::Rig;
pub use triangulate::{
    Left, Triangulated, View, triangulate, triangulate_dropping, triangulate_near,
    triangulate_robust,
};

use crate::core::so3;
use crate::core::time::Nanos;

/// Points closer to the camera plane than this (metres) are not projected.
const NEAR: f64 = 1e-3;
/// Largest entry of R^T R - I of a valid rotation (files hold rounded numbers).
const ROTATION_TOLERANCE: f64 = 1e-3;
/// A focal length below this many pixels makes the intrinsic matrix singular.
const MIN_FOCAL_PX: f64 = 1e-6;

/// Why a camera or a rig cannot be used. Its text says what is wrong, with units.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum CameraError {
    /// Also a matrix that is not upper triangular. `fx` and `fy` are its entries (0, 0) and (1, 1), pixels.
    #[error(
        "camera {camera}: the intrinsic matrix is singular or no pinhole matrix \
         (fx {fx}, fy {fy}, determinant {determinant}); it must be [fx s cx; 0 fy cy; 0 0 1] \
         with positive fx and fy in pixels"
    )]
    SingularIntrinsics { camera: String, fx: f64, fy: f64, determinant: f64 },
    /// Also a reflection. `off` is the largest absolute entry of R^T R - I.
    #[error(
        "camera {camera}: the rotation is no rotation (R^T R is off the identity by {off:.3e}, \
         determinant {determinant:.6}); check that the file holds a rotation from world to camera"
    )]
    NotARotation { camera: String, off: f64, determinant: f64 },
    #[error("camera {camera}: {field} holds a number that is not finite; calibrate it again")]
    NotFinite { camera: String, field: &'static str },
    #[error(
        "camera {camera}: the time offset is {ms:.3e} ms, more than a hundred years; \
         correct time_offset_ms"
    )]
    TimeOffset { camera: String, ms: f64 },
    #[error(
        "camera {camera}: the image size {width}x{height} is empty; give width and height in pixels"
    )]
    EmptyImage { camera: String, width: u32, height: u32 },
    #[error("a {model} lens has {expected} coefficients, not {found}")]
    CoefficientCount { model: &'static str, expected: &'static str, found: usize },
    #[error("a rig needs at least two cameras, this one has {found}; add calibrated cameras")]
    TooFewCameras { found: usize },
    #[error("two cameras of the rig are named {name}; give each a name of its own")]
    DuplicateName { name: String },
}

/// A calibrated camera that does not move.
///
/// pixel = focal * distort(normalised) + centre, with x also moved by skew * distorted y;
/// normalised = (x / z, y / z) of rotation * point + translation.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Unique in a rig.
    pub name: String,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// fx, fy, pixels.
    pub focal: Vector2<f64>,
    /// Principal point, pixels.
    pub centre: Vector2<f64>,
    /// Entry (0, 1) of the intrinsic matrix, pixels; nearly always 0.
    pub skew: f64,
    /// camera_from_world.
    pub rotation: Matrix3<f64>,
    /// camera_from_world, metres.
    pub translation: Vector3<f64>,
    /// Added to the capture times of the camera's frames, to agree with the other cameras.
    pub time_offset: Nanos,
    /// Private, because the next two follow from it.
    lens: Lens,
    /// Whether the lens has no distortion.
    ideal: bool,
    /// Square of the normalised radius up to which the lens model is one-to-one.
    limit_squared: f64,
}

impl Camera {
    /// Makes a camera after checking all values.
    ///
    /// `size` is width and height in pixels; `matrix` is \[fx s cx; 0 fy cy; 0 0 1\] in pixels;
    /// `rotation` and `translation` (metres) are camera_from_world. A rotation that is rounded
    /// is replaced by the nearest one.
    ///
    /// # Errors
    /// Numbers that are not finite, an empty image, a singular matrix, an invalid rotation.
    pub fn new(
        name: impl Into<String>,
        size: [u32; 2],
        matrix: &Matrix3<f64>,
        lens: Lens,
        rotation: Matrix3<f64>,
        translation: Vector3<f64>,
    ) -> Result<Self, CameraError> {
        let camera = name.into();
        let finite = |ok: bool, field: &'static str| match ok {
            true => Ok(()),
            false => Err(CameraError::NotFinite { camera: camera.clone(), field }),
        };
        finite(matrix.iter().all(|v| v.is_finite()), "the intrinsic matrix")?;
        finite(lens.coefficients().iter().all(|v| v.is_finite()), "the distortion")?;
        finite(rotation.iter().all(|v| v.is_finite()), "the rotation")?;
        finite(translation.iter().all(|v| v.is_finite()), "the translation")?;
        let [width, height] = size;
        if width == 0 || height == 0 {
            return Err(CameraError::EmptyImage { camera, width, height });
        }
        check_matrix(&camera, matrix)?;
        let rotation = nearest_rotation(&camera, &rotation)?;
        let limit = lens.limit();
        Ok(Self {
            name: camera,
            width,
            height,
            focal: Vector2::new(matrix[(0, 0)], matrix[(1, 1)]),
            centre: Vector2::new(matrix[(0, 2)], matrix[(1, 2)]),
            skew: matrix[(0, 1)],
            rotation,
            translation,
            time_offset: Nanos::ZERO,
            lens,
            ideal: lens.is_ideal(),
            limit_squared: limit * limit,
        })
    }

    /// The distortion model.
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// The intrinsic matrix \[fx s cx; 0 fy cy; 0 0 1\], pixels.
    pub fn matrix(&self) -> Matrix3<f64> {
        let (f, c) = (&self.focal, &self.centre);
        Matrix3::new(f.x, self.skew, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0)
    }

    /// The pixel of a world point (metres), perhaps outside the image. `None` behind the camera,
    /// within a millimetre of its plane, or where the distortion model folds back.
    #[inline]
    pub fn project(&self, world_point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = self.rotation * world_point + self.translation;
        let normalised = self.normalise(&p)?;
        if self.ideal {
            return Some(self.pixel_from_distorted(&normalised));
        }
        Some(self.pixel_from_distorted(&self.lens.distort(&normalised)))
    }

    /// The pixel of a world point, and its derivative by the point: 2x3, pixels per metre.
    /// `None` as for [`Camera::project`].
    ///
    /// J = \[fx s; 0 fy\] D P R, where D (2x2) is the lens's and
    /// P = 1/z \[1 0 -x/z; 0 1 -y/z\].
    #[inline]
    pub fn project_with_jacobian(
        &self,
        world_point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let p = self.rotation * world_point + self.translation;
        let normalised = self.normalise(&p)?;
        let affine = Matrix2::new(self.focal.x, self.skew, 0.0, self.focal.y);
        let (distorted, pixel_by_normalised) = if self.ideal {
            (normalised, affine)
        } else {
            let (distorted, by_normalised) = self.lens.distort_with_jacobian(&normalised);
            (distorted, affine * by_normalised)
        };
        let inv_z = 1.0 / p.z;
        let normalised_by_camera =
            Matrix2x3::new(inv_z, 0.0, -normalised.x * inv_z, 0.0, inv_z, -normalised.y * inv_z);
        let jacobian = pixel_by_normalised * (normalised_by_camera * self.rotation);
        Some((self.pixel_from_distorted(&distorted), jacobian))
    }

    /// Whether images of this width and height, pixels, are those of the calibration. If the calibrated size is twice the
    /// principal point, it may be a guess: then sizes within 10 % are accepted, but not scaled images.
    pub fn is_of_size(&self, size: [u32; 2]) -> bool {
        const ABOUT: f64 = 0.1;
        const SCALED: f64 = 0.003;
        let own = [self.width, self.height];
        let is_guessed = || [0, 1].map(|axis| (2.0 * self.centre[axis]).round() as u32) == own;
        let [x, y] = [0, 1].map(|axis| f64::from(size[axis]) / f64::from(own[axis]) - 1.0);
        let is_near = x.abs() < ABOUT && y.abs() < ABOUT && (x - y).abs() > SCALED;
        size == own || is_near && is_guessed()
    }

    /// Whether a pixel lies in the image.
    pub fn contains(&self, pixel: &Vector2<f64>) -> bool {
        let [width, height] = [self.width, self.height].map(f64::from);
        (0.0..width).contains(&pixel.x) && (0.0..height).contains(&pixel.y)
    }

    /// The normalised coordinates of a pixel, distortion removed. `None` if no point in front
    /// of the camera projects there, or the iteration does not converge.
    pub fn undistort(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let y = (pixel.y - self.centre.y) / self.focal.y;
        let x = (pixel.x - self.centre.x - self.skew * y) / self.focal.x;
        if self.ideal {
            return Some(Vector2::new(x, y)).filter(|v| v.iter().all(|c| c.is_finite()));
        }
        self.lens.undistort(&Vector2::new(x, y), self.limit_squared.sqrt())
    }

    /// Whether both are in the same place and look the same way, but for rounding.
    pub fn has_pose_of(&self, other: &Self) -> bool {
        const ROUNDING: f64 = 1e-9;
        (self.rotation - other.rotation).amax() < ROUNDING
            && (self.translation - other.translation).amax() < ROUNDING
    }

    /// The camera centre in the world, metres: -R^T t.
    pub fn centre_in_world(&self) -> Vector3<f64> {
        -self.rotation.tr_mul(&self.translation)
    }

    /// The unit direction of a pixel's ray in the world, from [`Camera::centre_in_world`]. `None`
    /// as for [`Camera::undistort`].
    pub fn ray(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let n = self.undistort(pixel)?;
        Some(self.rotation.tr_mul(&Vector3::new(n.x, n.y, 1.0)).normalize())
    }

    /// Depth of a world point along the optical axis, metres.
    pub fn depth(&self, world_point: &Vector3<f64>) -> f64 {
        self.rotation.row(2).tr_dot(world_point) + self.translation.z
    }

    #[inline]
    fn normalise(&self, camera_point: &Vector3<f64>) -> Option<Vector2<f64>> {
        if camera_point.z > NEAR {
            let normalised = camera_point.xy() / camera_point.z;
            (normalised.norm_squared() <= self.limit_squared).then_some(normalised)
        } else {
            None
        }
    }

    #[inline]
    fn pixel_from_distorted(&self, d: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(
            self.focal.x * d.x + self.skew * d.y + self.centre.x,
            self.focal.y * d.y + self.centre.y,
        )
    }
}

fn check_matrix(camera: &str, matrix: &Matrix3<f64>) -> Result<(), CameraError> {
    let (fx, fy) = (matrix[(0, 0)], matrix[(1, 1)]);
    let last_row = matrix[(2, 0)].abs() + matrix[(2, 1)].abs() + (matrix[(2, 2)] - 1.0).abs();
    if fx > MIN_FOCAL_PX && fy > MIN_FOCAL_PX && matrix[(1, 0)].abs() + last_row < 1e-9 {
        return Ok(());
    }
    Err(CameraError::SingularIntrinsics {
        camera: camera.to_owned(),
        fx,
        fy,
        determinant: matrix.determinant(),
    })
}

fn nearest_rotation(camera: &str, r: &Matrix3<f64>) -> Result<Matrix3<f64>, CameraError> {
    if !so3::is_rotation(r, ROTATION_TOLERANCE) {
        return Err(CameraError::NotARotation {
            camera: camera.to_owned(),
            off: (r.transpose() * r - Matrix3::identity()).amax(),
            determinant: r.determinant(),
        });
    }
    if so3::is_rotation(r, 1e-12) {
        return Ok(*r);
    }
    // One step of Newton's iteration for the polar factor squares the error; three reach 1e-16.
    Ok((0..3).fold(*r, |q, _| q * (Matrix3::identity() * 3.0 - q.transpose() * q) * 0.5))
}
