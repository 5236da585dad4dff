//! Association of several people: they cross, meet and hide each other, and each detection must go to
//! its person; people that nobody expected are found, and none are invented.

use std::time::Instant;

use bundlemocap::core::association::{
    Assigned, Association, Expectation, Gates, KEYPOINTS, LastSeen, Newcomer, Part, Points,
    associate, pixels_of, points_of,
};
use bundlemocap::core::body::{Pose, Shape, Skeleton};
use bundlemocap::core::camera::{Camera, Rig, triangulate_robust};
use bundlemocap::core::detections::{Detections, Keypoint, Person};
use bundlemocap::core::random::Draws;
use bundlemocap::research::synth::{Motion, MotionStyle, Noise, Recording, ring_rig};
use nalgebra::{Matrix3, Rotation3, Vector3};

const FPS: f64 = 60.0;
/// Speed of people who cross, m/s.
const SPEED: f64 = 1.2;
/// Bystanders stand beyond this distance from the middle, metres; others do not come there.
const EDGE: f64 = 2.05;

/// A detection and whose it is; `None` of a bystander.
type Owned = (Option<usize>, Person);

/// Where each person is, and what the cameras see.
struct Crowd {
    rig: Rig,
    /// By person and frame.
    truth: Vec<Vec<Points>>,
    /// By frame and camera.
    frames: Vec<Vec<Detections>>,
    /// By frame, camera and detection: whose it is; `None` of a bystander.
    whose: Vec<Vec<Vec<Option<usize>>>>,
}

impl Crowd {
    /// People whose places on the floor are `path(person, seconds)`.
    fn new(
        rig: Rig,
        people: usize,
        frames: usize,
        noise: &Noise,
        path: impl Fn(usize, f64) -> Vector3<f64>,
    ) -> Self {
        let mut truth = Vec::new();
        let mut seen: Vec<Vec<Vec<Owned>>> = vec![vec![Vec::new(); rig.cameras.len()]; frames];
        let mut merged: Vec<Vec<Detections>> = Vec::new();
        for person in 0..people {
            let draws = Draws { seed: 77, stream: person as u64 };
            let mut shape = Shape::default();
            shape.0[..4].copy_from_slice(&[draws.normals(0, 0), draws.normals(0, 1)].concat());
            let skeleton = Skeleton::new(shape);
            let style =
                MotionStyle { step_time: 0.5 + 0.02 * person as f64, ..MotionStyle::default() };
            let motion = Motion::new(&skeleton, style);
            let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), 2.4 * person as f64);
            let place = |seconds: f64| -> Pose {
                let mut pose = motion.pose(seconds + 1.7 * person as f64);
                let height = Vector3::y() * pose.root_position.y;
                pose.root_position = path(person, seconds) + height;
                pose.root_rotation = turn.matrix() * pose.root_rotation;
                pose
            };
            let at = |frame: usize| points_of(&place(frame as f64 / FPS), &skeleton);
            truth.push((0..frames).map(at).collect::<Vec<_>>());
            let mut recording = Recording::new(rig.clone(), skeleton.clone(), place);
            (recording.noise, recording.seed) = (noise.clone(), 5 + person as u64);
            (recording.fps, recording.frames) = (FPS, frames as u64);
            for frame in recording.detections() {
                let points = &truth[person][frame.frame as usize];
                for detection in &frame.people {
                    let is_own = distance(&rig, &frame, detection, points) < 0.3;
                    let entry = (is_own.then_some(person), detection.clone());
                    seen[frame.frame as usize][frame.camera].push(entry);
                }
                if person == 0 {
                    let at = frame.frame as usize;
                    merged.resize(merged.len().max(at + 1), Vec::new());
                    merged[at].push(Detections { people: Vec::new(), ..frame });
                }
            }
        }
        let mut whose = vec![vec![Vec::new(); rig.cameras.len()]; frames];
        for (at, cameras) in seen.into_iter().enumerate() {
            for (camera, mut people) in cameras.into_iter().enumerate() {
                hide(&rig.cameras[camera], &merged[at][camera], &mut people, &truth, at);
                let draws = Draws { seed: at as u64, stream: camera as u64 };
                let mut order: Vec<usize> = (0..people.len()).collect();
                order.sort_by(|a, b| {
                    draws.uniform(0, *a as u64).total_cmp(&draws.uniform(0, *b as u64))
                });
                whose[at][camera] = order.iter().map(|&i| people[i].0).collect();
                merged[at][camera].people = order.iter().map(|&i| people[i].1.clone()).collect();
            }
        }
        Self { rig, truth, frames: merged, whose }
    }

    /// People walk through the middle from all sides and pass each other there.
    fn crossing(people: usize, cameras: usize) -> Self {
        Self::passing(people, cameras, (0.1 * people as f64).max(0.35))
    }

    /// The same; each passes the middle at a distance of `aside` metres.
    fn passing(people: usize, cameras: usize, aside: f64) -> Self {
        let path = |person: usize, seconds: f64| {
            let angle = std::f64::consts::TAU * person as f64 / people as f64 + 0.3;
            let from = Vector3::new(aside, 0.0, SPEED * (seconds - 1.5));
            Rotation3::from_axis_angle(&Vector3::y_axis(), angle) * from
        };
        let rig = wide(ring_rig(cameras, 5.0, 2.0).unwrap(), 1000.0);
        Self::new(rig, people, 180, &Noise::studio(), path)
    }

    fn people(&self) -> usize {
        self.truth.len()
    }

    /// The points of each person some frames ago.
    fn expected(&self, frame: usize) -> Vec<Expectation> {
        let points = |person: &Vec<Points>| person[frame.saturating_sub(3)];
        self.truth
            .iter()
            .map(|p| Expectation { points: points(p), last: Vec::new(), is_hidden: false })
            .collect()
    }

    fn associate(&self, frame: usize, expected: &[Expectation]) -> Association {
        let frames: Vec<&Detections> = self.frames[frame].iter().collect();
        associate(&self.rig, &frames, expected, &Gates::default())
    }

    /// Whether a detection shows half of the person.
    fn is_seen(&self, frame: usize, camera: usize, person: usize) -> bool {
        let people = self.frames[frame][camera].people.iter().zip(&self.whose[frame][camera]);
        let mut own = people.filter(|(_, whose)| **whose == Some(person));
        own.any(|(sight, _)| sight.points.iter().flatten().count() >= 12)
    }

    /// Counts each person's detections of a frame.
    fn count(&self, frame: usize, found: &Association, counts: &mut Counts) {
        for (person, views) in found.performers.iter().enumerate() {
            for (camera, assigned) in views.iter().enumerate() {
                let owner = |sight: usize| self.whose[frame][camera][sight];
                match assigned.parts[Part::Upper as usize] {
                    Some(sight) if owner(sight) == Some(person) => counts.right += 1,
                    Some(_) => counts.wrong += 1,
                    None => counts.missed += u32::from(self.is_seen(frame, camera, person)),
                }
            }
        }
    }
}

#[derive(Debug, Default)]
struct Counts {
    right: u32,
    wrong: u32,
    missed: u32,
}

impl Counts {
    fn assert(&self, what: &str) {
        println!("{what}: {self:?}");
        assert!(self.right > 500, "{what}: {self:?}");
        assert!(f64::from(self.wrong) <= 0.002 * f64::from(self.right), "{what}: {self:?}");
        assert!(f64::from(self.missed) <= 0.01 * f64::from(self.right), "{what}: {self:?}");
    }
}

/// The same cameras with a shorter focal length, pixels.
fn wide(rig: Rig, focal: f64) -> Rig {
    let camera = |camera: Camera| {
        let c = camera.centre;
        let matrix = Matrix3::new(focal, 0.0, c.x, 0.0, focal, c.y, 0.0, 0.0, 1.0);
        let size = [camera.width, camera.height];
        let lens = *camera.lens();
        Camera::new(camera.name, size, &matrix, lens, camera.rotation, camera.translation).unwrap()
    };
    Rig::new(1, rig.cameras.into_iter().map(camera).collect()).unwrap()
}

/// Mean distance of a detection from points, as a fraction of their size in the image.
fn distance(rig: &Rig, frame: &Detections, person: &Person, points: &Points) -> f64 {
    let pixels = pixels_of(frame, person, 0.0);
    let projected = points.map(|point| rig.cameras[frame.camera].project(&point?));
    let heights = || projected.iter().flatten().map(|pixel| pixel.y);
    let size = heights().fold(f64::MIN, f64::max) - heights().fold(f64::MAX, f64::min);
    let both = pixels.iter().zip(&projected).filter_map(|(a, b)| Some((*a)? - (*b)?));
    let errors: Vec<f64> = both.map(|off| off.norm() / size).collect();
    errors.iter().sum::<f64>() / errors.len().max(1) as f64
}

/// Points behind the trunk of a nearer person are not seen, and people with few points are not.
fn hide(
    camera: &Camera,
    frame: &Detections,
    people: &mut Vec<Owned>,
    truth: &[Vec<Points>],
    at: usize,
) {
    use Keypoint as K;
    let trunk = |person: usize, growth: f64| {
        let corner = |keypoint: K| {
            let point = truth[person][at][keypoint as usize]?;
            Some((camera.project(&point)?, camera.depth(&point)))
        };
        let corners = [K::LShoulder, K::RShoulder, K::LHip, K::RHip].map(corner);
        let corners: Option<Vec<_>> = corners.into_iter().collect();
        let corners = corners?;
        let low = corners.iter().map(|c| c.0).reduce(|a, b| a.inf(&b))?;
        let high = corners.iter().map(|c| c.0).reduce(|a, b| a.sup(&b))?;
        let depth = corners.iter().map(|c| c.1).sum::<f64>() / 4.0;
        let margin = (high - low) * growth;
        Some((low - margin, high + margin, depth))
    };
    for (owner, person) in people.iter_mut() {
        let Some(own) = *owner else { continue };
        let Some((_, _, depth)) = trunk(own, 0.0) else { continue };
        for other in (0..truth.len()).filter(|other| *other != own) {
            let Some((low, high, before)) = trunk(other, 0.1) else { continue };
            for point in person.points.iter_mut().filter(|_| before < depth) {
                let is_hidden = |p: nalgebra::Vector2<f64>| {
                    (low.x..high.x).contains(&p.x) && (low.y..high.y).contains(&p.y)
                };
                *point = point.filter(|seen| !is_hidden(seen.pixel.coords));
            }
        }
    }
    people.retain(|(_, person)| pixels_of(frame, person, 0.0).iter().flatten().count() >= 4);
}

/// Distance of a person's hips from the middle of the floor, metres. Bystanders stand at its edge.
fn from_middle(points: &Points) -> f64 {
    let hips = [Keypoint::LHip, Keypoint::RHip].map(|hip| points[hip as usize]);
    hips.into_iter().flatten().map(|hip| hip.xz().norm()).fold(f64::MAX, f64::min)
}

/// Mean distance of the points that both have, metres.
fn apart(a: &Points, b: &Points) -> f64 {
    let both = a.iter().zip(b).filter_map(|(a, b)| Some(((*a)? - (*b)?).norm()));
    let (sum, count) = both.fold((0.0, 0.0), |(sum, count), off| (sum + off, count + 1.0));
    sum / count
}

/// The points of a person, triangulated from its detections; where that fails, the last ones.
fn triangulated(crowd: &Crowd, frame: usize, views: &[Assigned], last: &Points) -> Points {
    let seen: Vec<_> = crowd.frames[frame]
        .iter()
        .zip(views)
        .filter_map(|(frame, assigned)| Some((frame.camera, assigned.person(frame)?, frame)))
        .map(|(camera, person, frame)| (camera, pixels_of(frame, &person, 0.1)))
        .collect();
    std::array::from_fn(|at| {
        let views: Vec<_> = seen.iter().filter_map(|(c, p)| Some((*c, p[at]?, 1.0))).collect();
        let found = triangulate_robust(&crowd.rig, &views, 15.0, at as u64).map(|t| t.point);
        let is_near =
            |point: &Vector3<f64>| last[at].is_none_or(|last| (point - last).norm() < 0.3);
        found.filter(is_near).or(last[at])
    })
}

#[test]
fn people_who_cross_keep_their_detections() {
    for (people, cameras) in [(2, 4), (3, 4), (4, 4), (6, 4), (6, 8)] {
        let crowd = Crowd::crossing(people, cameras);
        let mut counts = Counts::default();
        for frame in 0..crowd.frames.len() {
            let found = crowd.associate(frame, &crowd.expected(frame));
            crowd.count(frame, &found, &mut counts);
        }
        counts.assert(&format!("{people} people, {cameras} cameras"));
    }
}

/// Nothing is known but what association found before.
#[test]
fn people_are_followed_from_frame_to_frame_without_a_tracker() {
    for (people, cameras, aside) in [(2, 4, 0.35), (2, 4, 0.12), (4, 4, 0.4), (6, 8, 0.6)] {
        let crowd = Crowd::passing(people, cameras, aside);
        let mut expected: Vec<Expectation> = crowd.expected(0);
        let mut counts = Counts::default();
        for frame in 0..crowd.frames.len() {
            let found = crowd.associate(frame, &expected);
            crowd.count(frame, &found, &mut counts);
            for (expected, views) in expected.iter_mut().zip(&found.performers) {
                expected.points = triangulated(&crowd, frame, views, &expected.points);
                let last = crowd.frames[frame].iter().zip(views);
                let last = last.map(|(frame, assigned)| {
                    Some(LastSeen::of(frame, &assigned.person(frame)?, 0.1))
                });
                expected.last = last.collect();
            }
        }
        counts.assert(&format!("followed: {people} people, {cameras} cameras, {aside} m"));
    }
}

#[test]
fn the_other_views_tell_who_it_is_where_one_view_or_the_prediction_is_wrong() {
    let crowd = Crowd::crossing(4, 6);
    let (mut counts, mut lost_camera) = (Counts::default(), Counts::default());
    for frame in 0..crowd.frames.len() {
        let mut expected = crowd.expected(frame);
        // All predictions are off by 15 cm, each in its own direction, which also swaps places.
        for (person, expected) in expected.iter_mut().enumerate() {
            let angle = 1.9 * person as f64 + 0.1 * frame as f64;
            let off = Vector3::new(angle.cos(), 0.0, angle.sin()) * 0.15;
            expected.points.iter_mut().flatten().for_each(|point| *point += off);
            // The detector of the first camera exchanges ids, and the last detections were those of
            // the neighbour.
            let wrong = pixels_of_truth(&crowd, 0, (person + 1) % 4, frame);
            expected.last =
                vec![Some(LastSeen { pixels: wrong, id: Some((person as i64 + 1) % 4) })];
        }
        let mut seen = crowd.frames[frame].clone();
        for (sight, owner) in seen[0].people.iter_mut().zip(&crowd.whose[frame][0]) {
            sight.id = owner.map(|owner| owner as i64);
        }
        let frames: Vec<&Detections> = seen.iter().collect();
        let found = associate(&crowd.rig, &frames, &expected, &Gates::default());
        crowd.count(frame, &found, &mut counts);
        let found = associate(&crowd.rig, &frames[..5], &expected, &Gates::default());
        crowd.count(frame, &found, &mut lost_camera);
    }
    counts.assert("wrong predictions");
    lost_camera.assert("and a missing view");
}

fn pixels_of_truth(
    crowd: &Crowd,
    camera: usize,
    person: usize,
    frame: usize,
) -> [Option<nalgebra::Vector2<f64>>; KEYPOINTS] {
    crowd.truth[person][frame].map(|point| crowd.rig.cameras[camera].project(&point?))
}

/// The first camera does not detect one person, and the predictions of both are off: there, the other's
/// detection is nearer to where the first was predicted.
#[test]
fn a_view_that_contradicts_the_others_loses() {
    let rig = wide(ring_rig(6, 5.0, 2.0).unwrap(), 1000.0);
    let path = |person: usize, _: f64| Vector3::new(0.45 * person as f64 - 0.225, 0.0, 0.0);
    let crowd = Crowd::new(rig, 2, 60, &Noise::clean(), path);
    let mut right = 0;
    for frame in 0..crowd.frames.len() {
        let mut expected = crowd.expected(frame);
        let points = expected.iter_mut().flat_map(|expected| expected.points.iter_mut());
        points.flatten().for_each(|point| point.x += 0.26);
        let mut seen = crowd.frames[frame].clone();
        let mut whose = crowd.whose[frame][0].iter();
        seen[0].people.retain(|_| whose.next() != Some(&Some(0)));
        let frames: Vec<&Detections> = seen.iter().collect();
        let found = associate(&crowd.rig, &frames, &expected, &Gates::default());
        let first = [0, 1].map(|person| found.performers[person][0].parts[0]);
        right += u32::from(first == [None, Some(0)]);
    }
    assert!(right >= 57, "{right} of 60");
}

/// Detections exchange their legs, or one has both people's.
#[test]
fn legs_of_the_neighbour_go_back() {
    let crowd = Crowd::new(
        wide(ring_rig(4, 5.0, 2.0).unwrap(), 1000.0),
        2,
        120,
        &Noise::clean(),
        |person, _| Vector3::new(0.1, 0.0, 0.8 * person as f64 - 0.4),
    );
    let legs = |keypoint: &Keypoint| matches!(Part::of(*keypoint), Part::LeftLeg | Part::RightLeg);
    let (mut back, mut all) = (0, 0);
    for frame in 0..crowd.frames.len() {
        let mut seen = crowd.frames[frame].clone();
        let whose = &crowd.whose[frame][1];
        let [Some(a), Some(b)] = [0, 1].map(|k| whose.iter().position(|w| *w == Some(k))) else {
            continue;
        };
        let format = seen[1].format;
        for (index, _) in format.keypoints().iter().enumerate().filter(|(_, k)| legs(k)) {
            let (first, second) =
                (seen[1].people[a].points[index], seen[1].people[b].points[index]);
            seen[1].people[b].points[index] = first;
            // In every second frame nobody has the legs of the second person.
            seen[1].people[a].points[index] = second.filter(|_| frame % 2 == 0);
        }
        let frames: Vec<&Detections> = seen.iter().collect();
        let found = associate(&crowd.rig, &frames, &crowd.expected(frame), &Gates::default());
        let parts = |person: usize| found.performers[person][1].parts;
        for leg in [Part::LeftLeg, Part::RightLeg].map(|leg| leg as usize) {
            all += 1;
            let second = if frame % 2 == 0 { Some(a) } else { None };
            back += u32::from(
                parts(0)[leg] == Some(b) && parts(1)[leg].is_none_or(|s| Some(s) == second),
            );
        }
        let upper = [0, 1].map(|person| parts(person)[Part::Upper as usize]);
        assert_eq!(upper, [Some(a), Some(b)], "frame {frame}");
    }
    assert!(all > 200 && f64::from(back) > 0.98 * f64::from(all), "{back} of {all}");
}

#[test]
fn people_whom_nobody_expected_are_found_and_none_are_invented() {
    for (people, used, cameras) in
        [(1, 2, 4), (2, 2, 4), (2, 4, 4), (4, 4, 4), (6, 4, 4), (6, 8, 8)]
    {
        let mut crowd = Crowd::crossing(people, cameras);
        crowd.frames.iter_mut().for_each(|frames| frames.truncate(used));
        let (mut found, mut missed, mut invented, mut wrong) = (0, 0, 0, 0);
        for frame in (0..crowd.frames.len()).step_by(5) {
            let newcomers = crowd.associate(frame, &[]).newcomers;
            let mut is_found = vec![false; people];
            for newcomer in &newcomers {
                let off = |person: usize| apart(&newcomer.points, &crowd.truth[person][frame]);
                let nearest = (0..people).min_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap();
                let is_bystander = from_middle(&newcomer.points) > EDGE;
                match off(nearest) < 0.15 && !is_found[nearest] {
                    true => is_found[nearest] = true,
                    false => invented += u32::from(!is_bystander),
                }
                for (camera, assigned) in newcomer.views.iter().enumerate() {
                    let sight = assigned.parts[0];
                    wrong += u32::from(sight.is_some_and(|sight| {
                        !is_bystander && crowd.whose[frame][camera][sight] != Some(nearest)
                    }));
                }
            }
            found += is_found.iter().map(|found| u32::from(*found)).sum::<u32>();
            let is_seen = |person: &usize| {
                let views = 0..used;
                views.filter(|camera| crowd.is_seen(frame, *camera, *person)).count() >= 2
            };
            missed += (0..people).filter(is_seen).map(|p| u32::from(!is_found[p])).sum::<u32>();
        }
        println!(
            "{people} people, {used} cameras: {found} found, {missed} missed, {invented} invented, {wrong} wrong views"
        );
        assert_eq!(invented, 0, "{people} people, {used} cameras");
        // Two cameras do not see hips and shoulders behind another person.
        let most = if used == 2 { 0.15 } else { 0.02 };
        assert!(
            f64::from(missed) <= most * f64::from(found),
            "{people} people, {used} cameras: {missed} of {found}"
        );
    }
}

/// A newcomer beside known performers is the only one.
#[test]
fn a_newcomer_is_found_beside_known_performers() {
    let crowd = Crowd::crossing(4, 4);
    let (mut once, mut all) = (0, 0);
    for frame in (0..crowd.frames.len()).step_by(6) {
        let found = crowd.associate(frame, &crowd.expected(frame)[..3]);
        let on_floor = |found: Association| {
            found.newcomers.into_iter().filter(|new| from_middle(&new.points) < EDGE).collect()
        };
        let new: Vec<Newcomer> = on_floor(found);
        assert!(new.iter().all(|new| apart(&new.points, &crowd.truth[3][frame]) < 0.15));
        (once, all) = (once + new.len(), all + 1);
        // Known performers are not found again.
        let new = on_floor(crowd.associate(frame, &crowd.expected(frame)));
        assert!(new.is_empty(), "frame {frame}: {new:?}");
    }
    assert!(once * 20 >= all * 18, "{once} of {all}");
}

#[test]
fn strange_input_is_nobodys() {
    let crowd = Crowd::crossing(2, 4);
    let mut seen = crowd.frames[10].clone();
    seen[1].camera = 99;
    seen[2].camera = 0;
    seen[3].people[0].points.truncate(3);
    for point in seen[3].people.iter_mut().flat_map(|p| p.points.iter_mut().flatten()) {
        point.pixel.x = f64::NAN;
    }
    let frames: Vec<&Detections> = seen.iter().collect();
    let found = associate(&crowd.rig, &frames, &crowd.expected(10), &Gates::default());
    for frame in 1..4 {
        assert!(found.performers.iter().all(|views| views[frame] == Assigned::default()));
        assert_eq!(found.nobody[frame].len(), seen[frame].people.len());
    }
    assert!(found.performers.iter().all(|views| views[0].parts[0].is_some()));
    let nothing = Expectation { points: [None; KEYPOINTS], last: Vec::new(), is_hidden: false };
    let found = associate(&crowd.rig, &frames, &[nothing], &Gates::default());
    assert_eq!(found.performers[0], vec![Assigned::default(); 4]);
    assert_eq!(associate(&crowd.rig, &[], &[], &Gates::default()), Association::default());
}

/// `cargo test --release --test it association_costs -- --ignored --nocapture`
#[test]
#[ignore = "measures"]
fn association_costs() {
    println!(
        "| people x cameras | detections | known, ms | newcomers, ms | found |\n|---|---|---|---|---|"
    );
    for (people, cameras) in [(1, 4), (6, 4), (10, 8), (20, 16), (50, 32)] {
        let side = (people as f64).sqrt().ceil();
        let path = |person: usize, _: f64| {
            let (row, column) = (person as f64 / side, person as f64 % side);
            let middle = 0.5 * (side - 1.0);
            Vector3::new(column - middle, 0.0, row.floor() - middle) * 1.2
        };
        let rig = wide(ring_rig(cameras, 5.0 + 0.8 * side, 2.5).unwrap(), 700.0);
        let crowd = Crowd::new(rig, people, 8, &Noise::studio(), path);
        let median = |of: &dyn Fn(usize)| {
            let mut times: Vec<f64> = (0..40)
                .map(|run| {
                    let start = Instant::now();
                    of(run % 8);
                    start.elapsed().as_secs_f64() * 1e3
                })
                .collect();
            times.sort_by(f64::total_cmp);
            times[20]
        };
        let expected: Vec<_> = (0..8).map(|frame| crowd.expected(frame)).collect();
        let known = median(&|frame| drop(crowd.associate(frame, &expected[frame])));
        let new = median(&|frame| drop(crowd.associate(frame, &[])));
        let detections: usize = crowd.frames[4].iter().map(|frame| frame.people.len()).sum();
        let found = crowd.associate(4, &[]).newcomers.len();
        assert_eq!(crowd.people(), people);
        println!("| {people} x {cameras} | {detections} | {known:.3} | {new:.3} | {found} |");
    }
}
