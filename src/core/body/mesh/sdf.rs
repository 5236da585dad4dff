//! The template in the rest pose, as a signed distance field: tubes, ellipsoids and round cones, joined with
//! fillets.
//!
//! Girths are those of \[Gordon 2014\], halfway between the sexes, to a few per cent: the tests of the
//! mesh compare them. Everything else is modelled by eye, to look like a person. Left side; the right
//! side is its mirror image.

use nalgebra::Vector3;

/// A section of a tube.
#[derive(Clone, Copy)]
struct Ring {
    /// Its place along the tube.
    at: f64,
    /// Half widths: along the first axis across, then forwards and backwards along the second.
    half: [f64; 3],
    /// Its centre, across.
    centre: [f64; 2],
}

const fn ring(at: f64, half: [f64; 3], centre: [f64; 2]) -> Ring {
    Ring { at, half, centre }
}

/// A limb: elliptical sections along an axis, and a cap at each end. Metres.
struct Tube {
    /// The axis along the tube, and the two axes across.
    axes: [usize; 3],
    /// From 0, elliptical, to 1, nearly rectangular.
    squareness: f64,
    /// How far the caps stand out at both ends.
    caps: [f64; 2],
    /// Sections, in order.
    rings: &'static [Ring],
}

/// From the crotch to the base of the neck.
const TRUNK: Tube = Tube {
    axes: [1, 0, 2],
    squareness: 0.3,
    caps: [0.05, 0.05],
    rings: &[
        ring(-0.120, [0.1250, 0.0918, 0.1080], [0.000, 0.000]),
        ring(-0.060, [0.1630, 0.1145, 0.1242], [0.000, 0.000]),
        ring(0.000, [0.1730, 0.1210, 0.1166], [0.000, 0.000]),
        ring(0.060, [0.1640, 0.1274, 0.0960], [0.000, 0.000]),
        ring(0.130, [0.1540, 0.1240, 0.0900], [0.000, 0.000]),
        ring(0.200, [0.1600, 0.1270, 0.1020], [0.000, 0.000]),
        ring(0.270, [0.1720, 0.1260, 0.1150], [0.000, 0.000]),
        ring(0.330, [0.1780, 0.1180, 0.1200], [0.000, 0.000]),
        ring(0.380, [0.1620, 0.0980, 0.1080], [0.000, -0.004]),
        ring(0.425, [0.1120, 0.0730, 0.0860], [0.000, -0.012]),
        ring(0.460, [0.0750, 0.0500, 0.0660], [0.000, -0.018]),
    ],
};

/// Into the head.
const NECK: Tube = Tube {
    axes: [1, 0, 2],
    squareness: 0.0,
    caps: [0.03, 0.03],
    rings: &[
        ring(0.430, [0.0592, 0.0504, 0.0594], [0.000, -0.020]),
        ring(0.475, [0.0496, 0.0504, 0.0522], [0.000, -0.016]),
        ring(0.520, [0.0461, 0.0513, 0.0504], [0.000, -0.008]),
        ring(0.600, [0.0470, 0.0504, 0.0522], [0.000, -0.002]),
    ],
};

/// From the ankle to the hip.
const LEG: Tube = Tube {
    axes: [1, 0, 2],
    squareness: 0.0,
    caps: [0.03, 0.08],
    rings: &[
        ring(-0.930, [0.0319, 0.0371, 0.0453], [0.086, -0.016]),
        ring(-0.895, [0.0350, 0.0350, 0.0412], [0.086, -0.018]),
        ring(-0.860, [0.0343, 0.0354, 0.0416], [0.086, -0.018]),
        ring(-0.800, [0.0395, 0.0385, 0.0447], [0.086, -0.016]),
        ring(-0.700, [0.0541, 0.0468, 0.0624], [0.087, -0.012]),
        ring(-0.620, [0.0603, 0.0520, 0.0738], [0.088, -0.008]),
        ring(-0.550, [0.0578, 0.0545, 0.0676], [0.087, -0.002]),
        ring(-0.490, [0.0600, 0.0632, 0.0600], [0.087, 0.004]),
        ring(-0.430, [0.0636, 0.0693, 0.0630], [0.088, 0.004]),
        ring(-0.350, [0.0770, 0.0830, 0.0768], [0.090, 0.003]),
        ring(-0.250, [0.0850, 0.0945, 0.0950], [0.0935, 0.000]),
        ring(-0.150, [0.0880, 0.1010, 0.1060], [0.0945, -0.002]),
        ring(-0.060, [0.0808, 0.0945, 0.1050], [0.098, -0.006]),
    ],
};

/// From the heel to the toes; its sole is cut flat.
const FOOT: Tube = Tube {
    axes: [2, 0, 1],
    squareness: 0.3,
    caps: [0.022, 0.016],
    rings: &[
        ring(-0.048, [0.0260, 0.0300, 0.0300], [0.087, -0.950]),
        ring(-0.015, [0.0300, 0.0400, 0.0320], [0.088, -0.950]),
        ring(0.030, [0.0340, 0.0600, 0.0320], [0.091, -0.950]),
        ring(0.075, [0.0410, 0.0400, 0.0300], [0.096, -0.955]),
        ring(0.115, [0.0470, 0.0200, 0.0260], [0.101, -0.960]),
        ring(0.150, [0.0440, 0.0120, 0.0220], [0.101, -0.965]),
        ring(0.176, [0.0330, 0.0090, 0.0160], [0.099, -0.969]),
    ],
};

/// From inside the chest to the wrist.
const ARM: Tube = Tube {
    axes: [0, 1, 2],
    squareness: 0.0,
    caps: [0.05, 0.02],
    rings: &[
        ring(0.120, [0.0570, 0.0597, 0.0659], [0.392, -0.022]),
        ring(0.175, [0.0570, 0.0587, 0.0620], [0.404, -0.024]),
        ring(0.230, [0.0535, 0.0546, 0.0577], [0.416, -0.026]),
        ring(0.300, [0.0494, 0.0505, 0.0515], [0.425, -0.028]),
        ring(0.380, [0.0433, 0.0453, 0.0453], [0.427, -0.030]),
        ring(0.447, [0.0410, 0.0432, 0.0454], [0.428, -0.031]),
        ring(0.510, [0.0431, 0.0473, 0.0462], [0.428, -0.029]),
        ring(0.590, [0.0378, 0.0420, 0.0410], [0.428, -0.027]),
        ring(0.660, [0.0280, 0.0330, 0.0320], [0.428, -0.026]),
        ring(0.705, [0.0225, 0.0300, 0.0290], [0.428, -0.025]),
        ring(0.735, [0.0205, 0.0340, 0.0330], [0.427, -0.024]),
    ],
};

/// From the wrist to the knuckles.
const PALM: Tube = Tube {
    axes: [0, 1, 2],
    squareness: 0.5,
    caps: [0.02, 0.015],
    rings: &[
        ring(0.725, [0.0175, 0.0320, 0.0320], [0.427, -0.024]),
        ring(0.755, [0.0165, 0.0380, 0.0360], [0.426, -0.023]),
        ring(0.785, [0.0145, 0.0400, 0.0380], [0.425, -0.023]),
        ring(0.805, [0.0115, 0.0370, 0.0360], [0.424, -0.023]),
    ],
};

/// Knuckle, middle and tip of each finger, and the radii at both ends.
const FINGERS: [([[f64; 3]; 3], [f64; 2]); 4] = [
    ([[0.795, 0.425, 0.010], [0.840, 0.424, 0.022], [0.879, 0.415, 0.033]], [0.0100, 0.0080]),
    ([[0.795, 0.425, -0.014], [0.848, 0.425, -0.011], [0.894, 0.416, -0.008]], [0.0102, 0.0082]),
    ([[0.795, 0.425, -0.036], [0.843, 0.424, -0.043], [0.882, 0.415, -0.051]], [0.0098, 0.0079]),
    ([[0.790, 0.423, -0.054], [0.826, 0.421, -0.068], [0.856, 0.413, -0.082]], [0.0088, 0.0072]),
];

impl Tube {
    /// The distance of `p`, measured from the axis outwards. Sections between the rings follow cubic
    /// curves through them.
    fn distance(&self, p: &Vector3<f64>) -> f64 {
        let [along, u, v] = self.axes.map(|axis| p[axis]);
        let last = self.rings.len() - 1;
        let inside = along.clamp(self.rings[0].at, self.rings[last].at);
        let k = self.rings[1..last].iter().take_while(|ring| ring.at <= inside).count();
        let h = self.rings[k + 1].at - self.rings[k].at;
        let s = (inside - self.rings[k].at) / h;
        let curve = |of: &dyn Fn(&Ring) -> f64| {
            let slope = |k: usize| {
                let (a, b) = (&self.rings[k.saturating_sub(1)], &self.rings[(k + 1).min(last)]);
                h * (of(b) - of(a)) / (b.at - a.at)
            };
            let (p0, p1) = (of(&self.rings[k]), of(&self.rings[k + 1]));
            let rise = (3.0 - 2.0 * s) * s * s;
            p0 + (p1 - p0) * rise + s * (1.0 - s) * ((1.0 - s) * slope(k) - s * slope(k + 1))
        };
        let (u, v) = (u - curve(&|ring| ring.centre[0]), v - curve(&|ring| ring.centre[1]));
        let a = curve(&|ring| ring.half[0]);
        let b = curve(&|ring| ring.half[if v > 0.0 { 1 } else { 2 }]);
        let beyond = along - inside;
        let cap = beyond / self.caps[usize::from(beyond > 0.0)];
        let (x, y) = ((u / a) * (u / a), (v / b) * (v / b));
        let section = (x + y) + self.squareness * ((x * x + y * y).sqrt() - (x + y));
        outwards(u * u + v * v + beyond * beyond, section + cap * cap)
    }
}

/// The depth of the middle of a part, metres; no part is thinner.
const INSIDE: f64 = 0.005;

/// The distance to a surface along the ray from its middle. `square`: squared distance from the middle, m².
/// `relative`: the same divided by that of the surface.
fn outwards(square: f64, relative: f64) -> f64 {
    match relative < 1e-6 {
        true => -INSIDE,
        false => square.sqrt() - (square / relative).sqrt(),
    }
}

fn ellipsoid(p: &Vector3<f64>, centre: [f64; 3], half: [f64; 3]) -> f64 {
    let from_centre = p - Vector3::from(centre);
    let relative = from_centre.component_div(&Vector3::from(half));
    outwards(from_centre.norm_squared(), relative.norm_squared())
}

/// A round cone: a bar whose radius changes from end to end.
fn round_cone(p: &Vector3<f64>, from: [f64; 3], to: [f64; 3], radii: [f64; 2]) -> f64 {
    let (from, to) = (Vector3::from(from), Vector3::from(to));
    let along = to - from;
    let s = ((p - from).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
    (p - from - along * s).norm() - (radii[0] + (radii[1] - radii[0]) * s)
}

/// The union, with a fillet of about `k`.
fn smooth_union(a: f64, b: f64, k: f64) -> f64 {
    let near = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - near * near * k / 4.0
}

/// `a` without `b`, with rounded edges.
fn smooth_difference(a: f64, b: f64, k: f64) -> f64 {
    -smooth_union(-a, b, k)
}

fn head(p: &Vector3<f64>) -> f64 {
    let skull = ellipsoid(p, [0.0, 0.648, -0.002], [0.0780, 0.092, 0.0995]);
    let face = ellipsoid(p, [0.0, 0.592, 0.032], [0.0590, 0.078, 0.067]);
    let jaw = ellipsoid(p, [0.0, 0.549, 0.048], [0.0400, 0.026, 0.046]);
    let chin = round_cone(p, [0.0, 0.534, 0.083], [0.007, 0.534, 0.082], [0.012, 0.012]);
    let brow = round_cone(p, [0.0, 0.648, 0.088], [0.042, 0.646, 0.072], [0.010, 0.009]);
    let cheek = ellipsoid(p, [0.040, 0.602, 0.064], [0.020, 0.018, 0.018]);
    let eye_socket = ellipsoid(p, [0.034, 0.626, 0.106], [0.019, 0.013, 0.022]);
    let eye = ellipsoid(p, [0.033, 0.628, 0.080], [0.0125, 0.0115, 0.0125]);
    let nose = round_cone(p, [0.0, 0.642, 0.092], [0.0, 0.603, 0.110], [0.008, 0.0105]);
    let nostril = ellipsoid(p, [0.011, 0.600, 0.100], [0.008, 0.008, 0.011]);
    let upper_lip = round_cone(p, [0.0, 0.5775, 0.095], [0.019, 0.573, 0.084], [0.0090, 0.006]);
    let lower_lip = round_cone(p, [0.0, 0.5580, 0.094], [0.016, 0.561, 0.085], [0.0090, 0.006]);
    let ear = ellipsoid(p, [0.080, 0.614, 0.000], [0.009, 0.028, 0.017]);
    let round = [(face, 0.03), (jaw, 0.03), (chin, 0.02), (brow, 0.015), (cheek, 0.02)];
    let round = round.into_iter().fold(skull, |all, (part, k)| smooth_union(all, part, k));
    let fine = [
        (eye, 0.008),
        (nose, 0.012),
        (nostril, 0.006),
        (upper_lip, 0.006),
        (lower_lip, 0.006),
        (ear, 0.008),
    ];
    let carved = smooth_difference(round, eye_socket, 0.012);
    fine.into_iter().fold(carved, |all, (part, k)| smooth_union(all, part, k))
}

fn hand(p: &Vector3<f64>) -> f64 {
    let palm = smooth_union(
        PALM.distance(p),
        ellipsoid(p, [0.755, 0.420, 0.004], [0.030, 0.014, 0.018]),
        0.015,
    );
    let fingers = FINGERS.map(|([knuckle, middle, tip], [thick, thin])| {
        let between = 0.5 * (thick + thin);
        let near = round_cone(p, knuckle, middle, [thick, between]);
        smooth_union(near, round_cone(p, middle, tip, [between, thin]), 0.004)
    });
    let thumb = smooth_union(
        round_cone(p, [0.735, 0.420, 0.000], [0.774, 0.408, 0.032], [0.015, 0.0115]),
        round_cone(p, [0.774, 0.408, 0.032], [0.815, 0.395, 0.056], [0.0115, 0.0085]),
        0.006,
    );
    let fingers = fingers.into_iter().fold(f64::INFINITY, f64::min);
    smooth_union(smooth_union(palm, fingers, 0.008), thumb, 0.012)
}

fn leg(p: &Vector3<f64>) -> f64 {
    let leg = LEG.distance(p);
    if p.y > -0.7 {
        return leg;
    }
    let big_toe = round_cone(p, [0.082, -0.965, 0.120], [0.083, -0.968, 0.172], [0.015, 0.011]);
    let foot = smooth_union(FOOT.distance(p), big_toe, 0.015);
    smooth_difference(smooth_union(leg, foot, 0.03), p.y + SOLE, 0.012)
}

/// Height of the pelvis above the soles, metres.
const SOLE: f64 = 0.980;

fn trunk(p: &Vector3<f64>) -> f64 {
    let chest = ellipsoid(p, [0.083, 0.288, 0.080], [0.064, 0.056, 0.050]);
    let buttock = ellipsoid(p, [0.077, -0.090, -0.070], [0.074, 0.080, 0.072]);
    smooth_union(smooth_union(TRUNK.distance(p), chest, 0.04), buttock, 0.035)
}

/// Signed distance of a point from the skin, metres, negative inside. Only its zero is exact: further away it is
/// right to about a factor of two.
pub(super) fn distance(p: &Vector3<f64>) -> f64 {
    let p = &Vector3::new(p.x.abs(), p.y, p.z);
    let mut arm = ARM.distance(p);
    if p.x > 0.6 {
        arm = smooth_union(arm, hand(p), 0.015);
    }
    let mut all = smooth_union(trunk(p), arm, 0.045);
    if p.y < 0.2 {
        all = smooth_union(all, leg(p), 0.03);
    }
    if p.y > 0.3 && p.x < 0.3 {
        all = smooth_union(all, smooth_union(NECK.distance(p), head(p), 0.02), 0.045);
    }
    all
}
