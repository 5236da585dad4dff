// example: dumps posed meshes
use bundlemocap::core::body::*;
use nalgebra::*;
use std::io::Write;
fn main() {
    let t = std::time::Instant::now();
    let mesh = Mesh::template();
    eprintln!("template {:?}", t.elapsed());
    let e = |x: f64, y: f64, z: f64| Rotation3::from_euler_angles(x, y, z).into_inner();
    let set = |list: &[(Joint, Matrix3<f64>)]| { let mut p = Pose::rest(); for (j, r) in list { p.local[j.index() - 1] = *r; } p };
    use Joint::*;
    let arms = [(LShoulder, e(0.0, 0.0, -1.2)), (RShoulder, e(0.0, 0.0, 1.2)), (LElbow, e(0.0, -0.25, 0.0)), (RElbow, e(0.0, 0.25, 0.0))];
    let walk = [arms.to_vec(), vec![(LHip, e(-0.45, 0., 0.)), (RHip, e(0.35, 0., 0.)), (LKnee, e(0.15, 0., 0.)), (RKnee, e(0.6, 0., 0.)), (LCollar, e(0.,0.,-0.1)), (RCollar, e(0.,0.,0.1)), (RShoulder, e(0.0, 0.5, 1.2)),(LShoulder, e(0.0, 0.5, -1.2))]].concat();
    let squat = vec![(LHip, e(-1.9, 0.0, 0.15)), (RHip, e(-1.9, 0.0, -0.15)), (LKnee, e(2.1, 0., 0.)), (RKnee, e(2.1, 0., 0.)), (Spine1, e(0.25, 0., 0.)), (Spine2, e(0.2, 0., 0.)), (LShoulder, e(0.0, -1.3, -0.2)), (RShoulder, e(0.0, 1.3, 0.2)), (LAnkle, e(-0.4, 0., 0.)), (RAnkle, e(-0.4, 0., 0.))];
    let up = vec![(LShoulder, e(0.0, 0.0, 1.1)), (RShoulder, e(0.0, 0.0, -1.1)), (LCollar, e(0.,0.,0.3)), (RCollar, e(0.,0.,-0.3)), (LElbow, e(0.0, -0.4, 0.0))];
    let curl = vec![(LElbow, e(0.0, -2.4, 0.0)), (RElbow, e(0.0, 1.5, 0.0)), (LShoulder, e(0.0, 0.0, -0.6)), (RKnee, e(2.3, 0., 0.)), (LHip, e(-1.5, 0., 0.)), (LKnee, e(1.5, 0., 0.)), (Head, e(0.3, 0.5, 0.)), (RShoulder, e(0., 0., 1.3))];
    let mut shapes = vec![Skeleton::default(); 3];
    shapes[1] = Skeleton::new(Shape::symmetric([2.0, -1.0, 0., 0., 0., 1.0, -1.0, 0., 0., 0.]));
    shapes[2] = Skeleton::new(Shape::symmetric([-2.0, 1.0, 0., 0., 0., -1.0, 1.0, 0., 0., 0.]));
    for (name, body, pose) in [("t", 0, vec![]), ("walk", 0, walk.clone()), ("squat", 0, squat), ("up", 0, up), ("curl", 0, curl), ("tall", 1, walk.clone()), ("short", 2, walk)] {
        let body = &shapes[body];
        let skin = mesh.posed(&mesh.rest(body), body, &set(&pose));
        let mut o = std::io::BufWriter::new(std::fs::File::create(format!("/tmp/sculpt/{name}.obj")).unwrap());
        for p in &skin { writeln!(o, "v {} {} {}", p.x, p.y, p.z).unwrap(); }
        for t in mesh.faces() { writeln!(o, "f {} {} {}", t[0] + 1, t[1] + 1, t[2] + 1).unwrap(); }
    }
}
