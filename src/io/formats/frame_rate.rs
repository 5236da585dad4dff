//! The frame rate of cameras, as the videos and settings beside their detections tell it.

use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mp4parse::{TrackType, read_mp4};

use super::ImportError;

/// Frame rates are alike if they differ by less than this part. 59.94 and 60 Hz differ by twice as much: a frame in 17 s.
const ALIKE: f64 = 0.0005;
/// Most bytes of a video's tables; ten hours of one have fewer.
const MOST_BYTES: u64 = 1 << 26;

/// A frame rate, hertz, and the file that tells it.
pub type FrameRate = (f64, PathBuf);

/// The frame rate of the cameras whose detections are in a folder or file, if a file tells it: Pose2Sim's `Config.toml`
/// in the folder or the two above, or MP4 videos in it or in `videos` or `synchronized_videos`, there or beside it.
///
/// # Errors
/// The videos have different frame rates.
pub fn frame_rate_beside(detections: &Path) -> Result<Option<FrameRate>, ImportError> {
    let whole = std::path::absolute(detections).map_err(|e| ImportError::read(detections, e))?;
    let folders = whole.ancestors().skip(usize::from(!whole.is_dir()));
    for (above, folder) in folders.take(3).enumerate() {
        let config = folder.join("Config.toml");
        if let Some(hz) = of_config(&config) {
            return Ok(Some((hz, config)));
        }
        let places = [folder.to_owned(), folder.join("videos"), folder.join("synchronized_videos")];
        // Above, other videos lie too.
        let all = places.iter().skip(above).flat_map(|place| videos(place));
        let rates: Vec<FrameRate> = all.filter_map(|path| Some((of_video(&path)?, path))).collect();
        if let Some((hz, path)) = rates.first() {
            return match rates.iter().find(|other| (other.0 / hz - 1.0).abs() > ALIKE) {
                None => Ok(rates.into_iter().next()),
                Some((other, second)) => Err(ImportError::FrameRates {
                    path: path.clone(),
                    hz: *hz,
                    second: second.clone(),
                    other: *other,
                }),
            };
        }
    }
    Ok(None)
}

/// The number in Pose2Sim's settings; `auto` is none.
fn of_config(path: &Path) -> Option<f64> {
    let config: toml::Table = toml::from_str(&fs::read_to_string(path).ok()?).ok()?;
    let rate = config.get("project")?.get("frame_rate")?;
    rate.as_float().or_else(|| rate.as_integer().map(|hz| hz as f64)).filter(|hz| *hz > 0.0)
}

/// The MP4 videos of a folder, by name.
fn videos(folder: &Path) -> Vec<PathBuf> {
    let is_video = |path: &PathBuf| {
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        ["mp4", "mov", "m4v"].iter().any(|one| ending == *one)
    };
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(is_video).collect();
    found.sort();
    found
}

/// The mean frame rate of a video, hertz.
fn of_video(path: &Path) -> Option<f64> {
    let video = read_mp4(&mut &*tables(path).ok()?).ok()?;
    let track = video.tracks.iter().find(|track| track.track_type == TrackType::Video)?;
    let runs = || track.stts.iter().flat_map(|times| times.samples.iter());
    let frames: u64 = runs().map(|run| u64::from(run.sample_count)).sum();
    let ticks: f64 =
        runs().map(|run| f64::from(run.sample_count) * f64::from(run.sample_delta)).sum();
    let seconds = ticks / track.timescale?.0 as f64;
    (seconds > 0.0).then(|| frames as f64 / seconds)
}

/// The boxes `ftyp` and `moov` of a video: without its images, which may be gigabytes.
fn tables(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut file = File::open(path)?;
    let end = file.metadata()?.len();
    let (mut at, mut kept) = (0, Vec::new());
    while at + 16 <= end {
        file.seek(SeekFrom::Start(at))?;
        let mut head = [0; 16];
        file.read_exact(&mut head)?;
        let [size, kind, large @ ..] = head.as_chunks::<4>().0 else { break };
        let size = match u32::from_be_bytes(*size) {
            0 => end - at,
            1 => large.iter().flatten().fold(0, |sum, byte| sum << 8 | u64::from(*byte)),
            size => u64::from(size),
        };
        if size < 8 || size > end - at {
            break;
        }
        if [b"ftyp", b"moov"].contains(&kind) {
            file.seek(SeekFrom::Start(at))?;
            (&mut file).take(size.min(MOST_BYTES)).read_to_end(&mut kept)?;
        }
        at += size;
    }
    Ok(kept)
}
