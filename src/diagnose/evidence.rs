//! What the cameras saw of the performers, to judge the cameras by.

use std::collections::VecDeque;
use std::sync::Arc;

use super::footage::Footage;
use super::{Check, check};
use crate::core::camera::Rig;
use crate::core::detections::{Detections, Person};
use crate::core::stage::{Claimed, Crowd, FrameSet, Owner, Performers};
use crate::core::tracker::{Config, FramePeriod};

/// Performers whose footage is kept: the first ones.
const PERFORMERS: usize = 4;
/// People of a frame that are kept, the largest: of single people with bystanders, and of crowds.
const MOST_PEOPLE: usize = 3;
const MOST_OF_CROWD: usize = 10;
/// Frames that are kept before the first one with several people.
const MOST_EARLY: usize = 1 << 15;
/// Below this part of frames with several people, they are not told from each other.
const SEVERAL: f64 = 0.02;
/// Frames that a late camera is waited for: nobody is in a hurry.
const PATIENCE: usize = 60;
/// A performer tells of the cameras if two of them see this part of all frames with somebody.
const SEEN: f64 = 0.2;
/// A camera in which each performer is found this much less often than in the best one may be wrong: it
/// sees somebody else where the performer should be.
const FOUND: f64 = 0.8;

/// The footage of a performer, and by camera the number of frames in which it was found.
#[derive(Clone, Debug)]
struct Seen {
    footage: Footage,
    found: Vec<usize>,
}

impl Seen {
    /// Whether a camera saw the performer much less often than another one.
    fn is_odd(&self, camera: usize) -> bool {
        let best = self.found.iter().copied().max().unwrap_or(0) as f64;
        (self.found[camera] as f64) < FOUND * best
    }
}

/// What the cameras saw. Detections are assigned to performers first, so that several people in view
/// are not taken for one. In the frames of a camera in which a performer is not found, everybody is kept
/// who is nobody else: a camera that is wrong sees the performer in another place.
#[derive(Clone, Debug)]
pub struct Evidence {
    rig: Arc<Rig>,
    config: Config,
    period: Option<FramePeriod>,
    /// `None` as long as no frame has several people.
    crowd: Option<Crowd>,
    /// The newest frames, for a crowd that begins later.
    early: VecDeque<Detections>,
    /// The largest people in each view, and everybody.
    largest: Footage,
    everybody: Footage,
    /// By camera: frames with somebody, and with several people.
    with_people: Vec<usize>,
    with_several: Vec<usize>,
    performers: Vec<Seen>,
    have_right_rates: bool,
}

impl Evidence {
    /// Nothing yet. `period` is the cameras' frame period, if it was measured before.
    pub fn new(rig: Arc<Rig>, config: Config, period: Option<FramePeriod>) -> Self {
        let cameras = rig.cameras.len();
        Self {
            config: Config { deadline_frames: config.deadline_frames.max(PATIENCE), ..config },
            period,
            crowd: None,
            early: VecDeque::new(),
            largest: Footage::new(cameras, MOST_PEOPLE),
            everybody: Footage::new(cameras, MOST_OF_CROWD),
            with_people: vec![0; cameras],
            with_several: vec![0; cameras],
            performers: Vec::new(),
            have_right_rates: false,
            rig,
        }
    }

    /// Tells that no camera's clock runs faster or slower than those of the others. Then no check names another frame rate.
    pub fn rates_are_right(&mut self) {
        self.have_right_rates = true;
    }

    /// Adds a frame, with the capture time of its camera. `percent` is the number of its points whose
    /// confidence was above 1 in the message.
    pub fn add(&mut self, frame: &Detections, percent: usize) {
        let (camera, people) = (frame.camera, frame.people.len());
        if camera >= self.rig.cameras.len() {
            return;
        }
        self.largest.add(frame);
        self.largest.add_percent(camera, percent);
        self.with_people[camera] += usize::from(people > 0);
        self.with_several[camera] += usize::from(people > 1);
        if people > 1 && self.crowd.is_none() {
            let rig = Arc::clone(&self.rig);
            self.crowd = Some(Crowd::new(rig, self.config, Performers::Auto, self.period));
            for frame in std::mem::take(&mut self.early) {
                self.add_to_crowd(&frame);
            }
        }
        if self.crowd.is_some() {
            self.add_to_crowd(frame);
            return;
        }
        self.early.push_back(frame.clone());
        if self.early.len() > MOST_EARLY {
            self.early.pop_front();
        }
    }

    fn add_to_crowd(&mut self, frame: &Detections) {
        if let Some(crowd) = &mut self.crowd {
            self.everybody.add(frame);
            crowd.add(frame.clone());
            self.follow(false);
        }
    }

    /// By camera, the number of frames with somebody.
    pub fn with_people(&self) -> &[usize] {
        &self.with_people
    }

    fn follow(&mut self, all: bool) {
        let Some(mut crowd) = self.crowd.take() else { return };
        while crowd.next(all).is_some() {
            self.saw(crowd.last());
        }
        crowd.events();
        self.crowd = Some(crowd);
    }

    /// Keeps the frames with each performer alone, or with everybody who is nobody else.
    fn saw(&mut self, set: &FrameSet) {
        let cameras = self.rig.cameras.len();
        let new =
            || Seen { footage: Footage::new(cameras, MOST_OF_CROWD), found: vec![0; cameras] };
        for &performer in set.performers.iter().filter(|performer| **performer < PERFORMERS) {
            self.performers.resize_with(self.performers.len().max(performer + 1), new);
            let Seen { footage, found } = &mut self.performers[performer];
            for Claimed { frame, owners } in &set.frames {
                let of = |wanted: Owner| -> Vec<Person> {
                    let all = frame.people.iter().zip(owners);
                    let own = all.filter(|(_, owner)| **owner == wanted);
                    own.map(|(person, _)| person.clone()).collect()
                };
                let mut people = of(Owner::Performer(performer));
                found[frame.camera] += usize::from(!people.is_empty());
                if people.is_empty() {
                    people = of(Owner::Nobody);
                }
                let capture = frame.capture - self.rig.cameras[frame.camera].time_offset;
                footage.add(&Detections { people, capture, ..*frame });
            }
        }
    }

    /// Judges the cameras by the performer who moved most; without one, by everybody in view. If a camera
    /// seems wrong, or sees people but not this performer, the other performers are checked too: a performer whom a camera
    /// often loses makes it look wrong, but a real fault shows with every performer. `rig` are the same cameras or the first
    /// of them, perhaps with other time offsets.
    pub fn check(mut self, rig: &Rig) -> Check {
        if let Some(crowd) = &mut self.crowd {
            crowd.end();
        }
        self.follow(true);
        let cameras = rig.cameras.len();
        for footage in [&mut self.largest, &mut self.everybody] {
            footage.have_right_rates = self.have_right_rates;
            footage.keep_first(cameras);
        }
        for Seen { footage, found } in &mut self.performers {
            footage.have_right_rates = self.have_right_rates;
            footage.keep_first(cameras);
            found.truncate(cameras);
        }
        self.with_people.truncate(cameras);
        self.with_several.truncate(cameras);
        let [several, all]: [usize; 2] =
            [&self.with_several, &self.with_people].map(|counts| counts.iter().sum());
        let least = self.with_people.iter().max().map_or(0.0, |most| SEEN * *most as f64);
        let is_enough =
            |one: &&Seen| one.found.iter().filter(|count| **count as f64 >= least).count() >= 2;
        let mut enough: Vec<&Seen> = self.performers.iter().filter(is_enough).collect();
        enough.sort_by(|a, b| b.footage.movement().total_cmp(&a.footage.movement()));
        let is_crowd = several as f64 > SEVERAL * all as f64;
        let judged = |alone: &Footage, footage: &Footage| {
            let everybody = if is_crowd { &self.everybody } else { &self.largest };
            check(&self.largest, everybody, alone, footage, rig)
        };
        let Some((mover, others)) = enough.split_first().filter(|_| is_crowd) else {
            return Check::of_performers(vec![judged(&self.largest, &self.largest)]);
        };
        let is_odd = |camera: usize| enough.iter().all(|one| one.is_odd(camera));
        let check_by = |Seen { footage, .. }: &Seen| {
            let alone = footage.with(&self.largest, is_odd);
            judged(&alone, &footage.with(&self.everybody, is_odd))
        };
        let by_mover = check_by(mover);
        if by_mover.is_of_all() || by_mover.tells_of_motion() {
            return by_mover;
        }
        let by_others = others.iter().map(|other| check_by(other));
        Check::of_performers(std::iter::once(by_mover).chain(by_others).collect())
    }
}
