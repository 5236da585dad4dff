//! The report of a solve: one HTML file with its plots inside it.

use std::fmt::Write as _;
use std::path::Path;

use nalgebra::Vector3;

use super::bars::Bars;
use super::plot::{Plot, Series, escape};
use crate::core::body::{JOINTS, Joint};
use crate::io::formats::ExportError;
use crate::io::new_file;

/// Content of a report. Empty parts are left out.
#[derive(Clone, Debug, Default)]
pub struct ReportData {
    /// What was solved.
    pub title: String,
    /// One line of description.
    pub subtitle: String,
    /// The most important metrics, as name and value.
    pub facts: Vec<(String, String)>,
    /// The take in 3D.
    pub player: Option<super::Player>,
    /// Tables at the top, over the whole width.
    pub leading: Vec<Table>,
    /// Further metrics, at the end.
    pub tables: Vec<Table>,
    /// Bars of any kind, before the other plots.
    pub bars: Vec<Bars>,
    /// Curves of any kind, before the other plots.
    pub plots: Vec<Plot>,
    /// Stick figures, see [`super::stick_figures`].
    pub pictures: Vec<Picture>,
    /// Reprojection error of each camera.
    pub cameras: Vec<CameraErrors>,
    /// Joint angles; left and right share a plot.
    pub angles: Vec<AngleTrack>,
    /// The windows in order of time.
    pub windows: Vec<WindowRow>,
    /// Parts of the page, each with its title and content, after all others.
    pub parts: Vec<ReportData>,
}

/// A table of text.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// Heading.
    pub title: String,
    /// Names of the columns.
    pub header: Vec<String>,
    /// Rows with one cell per column.
    pub rows: Vec<Vec<String>>,
}

/// An SVG with a heading.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Heading.
    pub title: String,
    /// A whole `<svg>` element, inserted without escaping.
    pub svg: String,
}

/// Reprojection errors of one camera over time.
#[derive(Clone, Debug)]
pub struct CameraErrors {
    /// Name of the camera.
    pub name: String,
    /// Per frame: seconds from the start; 25th, 50th and 75th percentile over the points, pixels;
    /// NaN without detections.
    pub frames: Vec<(f64, [f64; 3])>,
}

/// Angle at a joint over time.
#[derive(Clone, Debug)]
pub struct AngleTrack {
    /// The joint.
    pub joint: Joint,
    /// Seconds from the start and degrees.
    pub degrees: Vec<(f64, f64)>,
}

/// A window of the solve.
#[derive(Clone, Copy, Debug)]
pub struct WindowRow {
    /// Start, seconds from the start of the recording.
    pub start_s: f64,
    /// End, seconds from the start of the recording.
    pub end_s: f64,
    /// Norm of its keyframe's latent code.
    pub latent_norm: f64,
    /// Iterations of the optimiser.
    pub iterations: usize,
    /// Final cost.
    pub cost: f64,
    /// Solve time, milliseconds.
    pub solve_ms: f64,
    /// Begin and end of what is lost, seconds from the start of the recording; `None`: nothing is.
    pub lost_s: Option<[f64; 2]>,
}

/// The joints whose flexion is shown.
pub const BENT: [Joint; 4] = [Joint::LKnee, Joint::RKnee, Joint::LElbow, Joint::RElbow];

/// Flexion of a joint: the angle between the bone that ends in it and the bone that starts from it,
/// degrees; 0 is straight. `positions`: those of all joints. `None` at the pelvis and at joints without a next bone.
pub fn flexion_deg(positions: &[Vector3<f64>; JOINTS], joint: Joint) -> Option<f64> {
    let parent = joint.parent()?;
    let child = Joint::ALL.into_iter().find(|child| child.parent() == Some(joint))?;
    let at = |joint: Joint| positions[joint.index()];
    Some((at(joint) - at(parent)).angle(&(at(child) - at(joint))).to_degrees())
}

/// Writes the report; the file appears whole or not at all.
///
/// # Errors
/// The folder is not writable.
pub fn write_report(path: &Path, data: &ReportData) -> Result<(), ExportError> {
    new_file::write(path, html(data).as_bytes()).map_err(ExportError::write(path))
}

/// The whole page.
fn html(data: &ReportData) -> String {
    let page = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>{title}</title>\n<style>{STYLE}</style></head>\n<body><main>\n\
         <h1>{title}</h1>\n<p class=\"subtitle\">{}</p>\n",
        escape(&data.subtitle),
        title = escape(&data.title)
    );
    let mut page = page + &content(data);
    for part in &data.parts {
        let _ = writeln!(page, "<h2>{}</h2>", escape(&part.title));
        page += &content(part);
    }
    page + "</main></body></html>\n"
}

/// Everything below the title.
fn content(data: &ReportData) -> String {
    let mut page = String::new();
    page += "<dl class=\"facts\">\n";
    for (name, value) in &data.facts {
        let _ = writeln!(page, "<div><dt>{}</dt><dd>{}</dd></div>", escape(name), escape(value));
    }
    page += "</dl>\n";
    data.player.iter().for_each(|player| page += &player.html());
    for picture in &data.pictures {
        let title = escape(&picture.title);
        let _ = writeln!(
            page,
            "<section class=\"picture\"><h3>{title}</h3><div class=\"scroll\">{}</div></section>",
            picture.svg
        );
    }
    if !data.leading.is_empty() {
        let tables: String = data.leading.iter().map(table_html).collect();
        let _ = writeln!(page, "<div class=\"leading\">{tables}</div>");
    }
    page += "<div class=\"plots\">\n";
    page += &data.bars.iter().map(Bars::html).collect::<String>();
    page += &data.plots.iter().map(Plot::html).collect::<String>();
    for plot in plots(data).iter().filter(|plot| !plot.series.is_empty()) {
        page += &plot.html();
    }
    page += "</div>\n<div class=\"tables\">\n";
    for table in &data.tables {
        page += &table_html(table);
    }
    page + "</div>\n"
}

fn table_html(table: &Table) -> String {
    let cells = |row: &[String], tag: &str| -> String {
        row.iter().map(|cell| format!("<{tag}>{}</{tag}>", escape(cell))).collect()
    };
    let rows: String =
        table.rows.iter().map(|row| format!("<tr>{}</tr>\n", cells(row, "td"))).collect();
    format!(
        "<section><h3>{}</h3><div class=\"scroll\"><table><thead><tr>{}</tr></thead>\n\
         <tbody>{rows}</tbody></table></div></section>\n",
        escape(&table.title),
        cells(&table.header, "th")
    )
}

fn plots(data: &ReportData) -> Vec<Plot> {
    let shaded: Vec<(f64, f64)> = lost_intervals(&data.windows);
    let mut plots = vec![reprojection(&data.cameras)];
    plots.extend(angles(&data.angles));
    plots.extend(windows(&data.windows));
    for plot in &mut plots {
        plot.x_label = "time (s)".into();
        plot.shaded = shaded.clone();
        plot.shaded_name = "lost".into();
    }
    plots
}

/// Time spans of lost windows; adjacent spans are merged.
fn lost_intervals(windows: &[WindowRow]) -> Vec<(f64, f64)> {
    let mut spans: Vec<(f64, f64)> = Vec::new();
    for [from, to] in windows.iter().filter_map(|window| window.lost_s) {
        match spans.last_mut() {
            Some(last) if from <= last.1 + 1e-6 => last.1 = to,
            _ => spans.push((from, to)),
        }
    }
    spans
}

fn reprojection(cameras: &[CameraErrors]) -> Plot {
    let series = cameras.iter().enumerate().map(|(colour, camera)| Series {
        name: camera.name.clone(),
        points: camera.frames.iter().map(|&(t, [_, median, _])| (t, median)).collect(),
        band: camera.frames.iter().map(|&(t, [low, _, high])| (t, low, high)).collect(),
        dashed: false,
        colour,
    });
    Plot {
        title: "Reprojection error".into(),
        note: "Median over the points of each camera; the band is the 25th to 75th percentile."
            .into(),
        y_label: "error (px)".into(),
        series: series.collect(),
        ..Plot::default()
    }
}

/// One plot per joint and its mirror.
fn angles(tracks: &[AngleTrack]) -> Vec<Plot> {
    let mut plots: Vec<(Joint, Plot)> = Vec::new();
    for track in tracks {
        let joint = track.joint.min(track.joint.mirrored());
        let right = joint != track.joint;
        let series = Series {
            name: if right { "right" } else { "left" }.into(),
            points: track.degrees.clone(),
            dashed: right,
            colour: usize::from(right),
            ..Series::default()
        };
        match plots.iter_mut().find(|(of, _)| *of == joint) {
            Some((_, plot)) => plot.series.push(series),
            None => plots.push((joint, angle_plot(joint, series))),
        }
    }
    plots.into_iter().map(|(_, plot)| plot).collect()
}

fn angle_plot(joint: Joint, series: Series) -> Plot {
    let name = joint.name().trim_start_matches("l_");
    let (first, rest) = name.split_at(1);
    Plot {
        title: format!("{}{rest} angle", first.to_uppercase()),
        note: "Flexion; 0 is straight.".into(),
        y_label: "flexion (°)".into(),
        series: vec![series],
        ..Plot::default()
    }
}

fn windows(rows: &[WindowRow]) -> Vec<Plot> {
    let plot = |title: &str, note: &str, y_label: &str, value: fn(&WindowRow) -> f64| {
        let points: Vec<(f64, f64)> =
            rows.iter().map(|row| (0.5 * (row.start_s + row.end_s), value(row))).collect();
        let series = Series { points, ..Series::default() };
        Plot {
            title: title.into(),
            note: note.into(),
            y_label: y_label.into(),
            series: if rows.is_empty() { Vec::new() } else { vec![series] },
            ..Plot::default()
        }
    };
    let mut cost =
        plot("Window cost", "Final value of the objective in each window.", "cost", |row| row.cost);
    cost.log = true;
    vec![
        plot(
            "Latent norm",
            "Norm of each keyframe's code; a large norm is an unusual pose.",
            "|z|",
            |row| row.latent_norm,
        ),
        plot("Iterations", "Iterations of the optimiser per window.", "iterations", |row| {
            row.iterations as f64
        }),
        cost,
        plot("Solve time", "Solve time per window.", "time (ms)", |row| row.solve_ms),
    ]
}

const STYLE: &str = include_str!("page.css");

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::body::{Pose, Skeleton};
    use crate::core::so3;

    fn window(index: usize, lost: bool) -> WindowRow {
        let start_s = index as f64;
        let end_s = start_s + 1.0;
        let (latent_norm, iterations) = (4.0, 7);
        let lost_s = lost.then_some([start_s, end_s]);
        WindowRow { start_s, end_s, latent_norm, iterations, cost: 10.0, solve_ms: 8.0, lost_s }
    }

    #[test]
    fn neighbouring_lost_windows_are_one_interval() {
        let windows: Vec<WindowRow> = [false, true, true, false, true]
            .iter()
            .enumerate()
            .map(|(i, &l)| window(i, l))
            .collect();
        assert_eq!(lost_intervals(&windows), [(1.0, 3.0), (4.0, 5.0)]);
    }

    #[test]
    fn left_and_right_share_a_plot() {
        let joints = [Joint::LKnee, Joint::RKnee, Joint::RElbow];
        let tracks = joints.map(|joint| AngleTrack { joint, degrees: vec![(0.0, 1.0)] });
        let plots = angles(&tracks);
        let titles: Vec<&str> = plots.iter().map(|p| p.title.as_str()).collect();
        assert_eq!(titles, ["Knee angle", "Elbow angle"]);
        assert_eq!((plots[0].series.len(), plots[1].series.len()), (2, 1));
        assert!(plots[1].series[0].dashed);
    }

    #[test]
    fn flexion_is_the_angle_between_bones() {
        let mut pose = Pose::rest();
        let straight =
            flexion_deg(&pose.posture(&Skeleton::default()).positions, Joint::LElbow).unwrap();
        pose.local[Joint::LElbow.index() - 1] = so3::exp(&Vector3::new(0.0, -1.2, 0.0));
        let bent =
            flexion_deg(&pose.posture(&Skeleton::default()).positions, Joint::LElbow).unwrap();
        assert!(straight < 3.0 && (bent - 1.2f64.to_degrees()).abs() < 3.0, "{straight} {bent}");
        assert_eq!(flexion_deg(&pose.posture(&Skeleton::default()).positions, Joint::LWrist), None);
    }

    #[test]
    fn text_is_escaped_and_an_empty_report_is_a_page() {
        let data = ReportData { title: "a <b> & c".into(), ..ReportData::default() };
        let page = html(&data);
        assert!(page.contains("<h1>a &lt;b&gt; &amp; c</h1>") && !page.contains("<svg"));
    }
}
