//! A closed triangle mesh of the skin, by dual contouring: a vertex in every cell that the skin
//! passes through, a quad about every edge that it crosses. Cells are smaller at the hands, the face
//! and the feet; where they meet larger ones, a quad has a corner less.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::sdf::distance;

/// The smallest cells, metres. With some sizes the skin passes twice through a cell; then the mesh is not
/// closed, and a test fails.
const UNIT: f64 = 0.00744;
/// Size of a block, units. All cells of a block have one size.
const BLOCK: i32 = 8;
/// Ranges of the left side's blocks on x, y and z; the ends are excluded.
const BLOCKS: [[i32; 2]; 3] = [[0, 18], [-19, 15], [-3, 4]];
/// Rounds of moving each vertex towards the middle of its neighbours.
const ROUNDS: usize = 5;

/// A cell: its corner of the smallest coordinates, and its size, in units.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Cell {
    corner: [i32; 3],
    size: i32,
}

impl Cell {
    /// The cell around a point, given in half units.
    fn around(point: [i32; 3]) -> Self {
        let size = cell_size(point.map(|x| x.div_euclid(2 * BLOCK)));
        Self { corner: point.map(|x| x.div_euclid(2 * size) * size), size }
    }

    fn mirrored(self) -> Self {
        let [x, y, z] = self.corner;
        Self { corner: [-x - self.size, y, z], ..self }
    }

    fn is_left(&self) -> bool {
        self.corner[0] >= 0
    }
}

/// The middle of a block, metres.
fn middle(block: [i32; 3]) -> Vector3<f64> {
    place(block.map(|k| k * BLOCK + BLOCK / 2))
}

/// The size of a block's cells, units.
fn cell_size(block: [i32; 3]) -> i32 {
    let [x, y, z] = middle(block).into();
    let x = x.abs();
    let is_face_or_fingers = x > 0.76 || (y > 0.52 && z > 0.05 && x < 0.05);
    let is_hand_head_or_foot = x > 0.65 || (y > 0.50 && z > -0.04) || (y < -0.88 && z > -0.03);
    let is_elbow_or_knee = (x - 0.447).abs() < 0.06 || (y + 0.489).abs() < 0.06;
    match (is_face_or_fingers, is_hand_head_or_foot || is_elbow_or_knee) {
        (true, _) => 1,
        (false, true) => 2,
        (false, false) => 4,
    }
}

/// A corner of cells in the rest pose, metres.
fn place(point: [i32; 3]) -> Vector3<f64> {
    Vector3::from(point.map(|k| f64::from(k) * UNIT))
}

/// The template's vertices and faces: the vertices of the left side, then their mirror images in the
/// same order; faces counter-clockwise, seen from outside.
pub(super) fn polygonise() -> (Vec<Vector3<f64>>, Vec<[u32; 3]>) {
    let (cells, quads) = contour();
    let number: BTreeMap<Cell, u32> = cells.keys().copied().zip(0..).collect();
    let half = number.len() as u32;
    let index = |cell: Cell| match cell.is_left() {
        true => number[&cell],
        false => number[&cell.mirrored()] + half,
    };
    let quads: Vec<[u32; 4]> = quads.iter().map(|quad| quad.map(index)).collect();
    let mut vertices: Vec<Vector3<f64>> = cells.values().map(|(sum, n)| sum / *n).collect();
    vertices.iter_mut().for_each(project);
    mirror(&mut vertices);
    for _ in 0..ROUNDS {
        relax(&mut vertices, &quads);
    }
    let faces = quads.iter().flat_map(|quad| triangles(*quad, &vertices)).collect();
    (vertices, faces)
}

/// The cells of the left side that the skin passes through, each with the sum and the number of the
/// crossings of its edges; and the quads of both sides.
type Contour = (BTreeMap<Cell, (Vector3<f64>, f64)>, Vec<[Cell; 4]>);

fn contour() -> Contour {
    let (mut cells, mut quads) = (BTreeMap::new(), Vec::new());
    let mut distances: BTreeMap<[i32; 3], f64> = BTreeMap::new();
    let mut at = |point| *distances.entry(point).or_insert_with(|| distance(&place(point)));
    for Cell { corner, size } in left_cells() {
        for (axis, along_u, along_v) in (0..12).map(|k| (k / 4, k & 1, k >> 1 & 1)) {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut from = corner;
            from[u] += size * along_u as i32;
            from[v] += size * along_v as i32;
            let mut to = from;
            to[axis] += size;
            let quad = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(|[to_u, to_v]| {
                let mut point = from.map(|x| 2 * x);
                point[axis] += size;
                point[u] += to_u;
                point[v] += to_v;
                Cell::around(point)
            });
            // An edge belongs to the smallest cells around it. The last of them makes the quad.
            let smallest = quad.iter().map(|cell| cell.size).min();
            let in_charge = quad.iter().filter(|cell| Some(cell.size) == smallest).max();
            if in_charge != Some(&Cell { corner, size }) {
                continue;
            }
            let (d0, d1) = (at(from), at(to));
            if (d0 < 0.0) == (d1 < 0.0) {
                continue;
            }
            let crossing = place(from).lerp(&place(to), d0 / (d0 - d1));
            for cell in quad.into_iter().filter(Cell::is_left) {
                let (sum, n) = cells.entry(cell).or_insert((Vector3::zeros(), 0.0));
                *sum += crossing;
                *n += 1.0;
            }
            let [a, b, c, d] = quad;
            let outwards = if d0 < 0.0 { quad } else { [d, c, b, a] };
            quads.push(outwards);
            if quad.iter().all(Cell::is_left) {
                let [a, b, c, d] = outwards.map(Cell::mirrored);
                quads.push([d, c, b, a]);
            }
        }
    }
    (cells, quads)
}

/// The cells of all blocks of the left side that are near the skin.
fn left_cells() -> impl Iterator<Item = Cell> {
    let [xs, ys, zs] = BLOCKS.map(|[from, to]| from..to);
    let blocks = xs.flat_map(move |x| {
        let zs = zs.clone();
        ys.clone().flat_map(move |y| zs.clone().map(move |z| [x, y, z]))
    });
    let near =
        blocks.filter(|block| distance(&middle(*block)).abs() < 1.2 * f64::from(BLOCK) * UNIT);
    near.flat_map(|block| {
        let size = cell_size(block);
        let n = BLOCK / size;
        (0..n * n * n).map(move |k| {
            let inside = [k % n, k / n % n, k / n / n];
            let corner = std::array::from_fn(|axis| block[axis] * BLOCK + inside[axis] * size);
            Cell { corner, size }
        })
    })
}

/// Moves a point onto the skin.
fn project(p: &mut Vector3<f64>) {
    const STEP: f64 = 1e-4;
    for _ in 0..2 {
        let d = distance(p);
        let slope = Vector3::from_fn(|axis, _| {
            let mut beside = *p;
            beside[axis] += STEP;
            (distance(&beside) - d) / STEP
        });
        *p -= slope * (d / slope.norm_squared().max(0.1)).clamp(-UNIT, UNIT);
    }
}

/// Appends the mirror image of each vertex.
fn mirror(vertices: &mut Vec<Vector3<f64>>) {
    let images: Vec<_> = vertices.iter().map(|p| Vector3::new(-p.x, p.y, p.z)).collect();
    vertices.extend(images);
}

/// Moves each vertex halfway to the middle of its neighbours and back onto the skin.
fn relax(vertices: &mut Vec<Vector3<f64>>, quads: &[[u32; 4]]) {
    let mut sums = vec![(Vector3::zeros(), 0.0); vertices.len()];
    for quad in quads {
        for k in 0..4 {
            let (a, b) = (quad[k] as usize, quad[(k + 1) % 4] as usize);
            if a != b {
                sums[a] = (sums[a].0 + vertices[b], sums[a].1 + 1.0);
                sums[b] = (sums[b].0 + vertices[a], sums[b].1 + 1.0);
            }
        }
    }
    vertices.truncate(sums.len() / 2);
    for (p, (sum, n)) in vertices.iter_mut().zip(sums) {
        *p = p.lerp(&(sum / n), 0.5);
        project(p);
    }
    mirror(vertices);
}

/// A quad, cut along its shorter diagonal; a triangle if two of its corners are one.
fn triangles([a, b, c, d]: [u32; 4], vertices: &[Vector3<f64>]) -> impl Iterator<Item = [u32; 3]> {
    let length = |a: u32, b: u32| (vertices[a as usize] - vertices[b as usize]).norm();
    let both = match length(a, c) < length(b, d) {
        true => [[a, b, c], [a, c, d]],
        false => [[a, b, d], [b, c, d]],
    };
    both.into_iter().filter(|[a, b, c]| a != b && b != c && c != a)
}
