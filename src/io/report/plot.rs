//! Line plots as SVG; the legend is HTML beside it, so that it stays readable at small size.

use std::fmt::Write as _;

use crate::core::points::median;

/// Coordinates inside the SVG; the page scales it.
const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 250.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 10.0;
const TOP: f64 = 10.0;
const BOTTOM: f64 = 40.0;
/// Longer curves are averaged in groups.
const MOST_POINTS: usize = 900;
/// In a curve of many points, a distance of so many usual ones is a gap.
const GAP: f64 = 4.0;
const MANY_POINTS: usize = 16;
/// Colours that colour-blind people can distinguish \[Okabe 2008\].
pub(super) const PALETTE: [&str; 7] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444"];

/// A curve. Points are (x, y) with ascending x; a y that is not finite leaves a gap.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Name in the legend; empty: not in the legend.
    pub name: String,
    /// Points of the curve.
    pub points: Vec<(f64, f64)>,
    /// Band behind the curve: (x, low, high).
    pub band: Vec<(f64, f64, f64)>,
    /// Whether the line is dashed.
    pub dashed: bool,
    /// Index into the palette.
    pub colour: usize,
}

/// A plot of curves over one x axis.
#[derive(Clone, Debug, Default)]
pub struct Plot {
    /// Heading.
    pub title: String,
    /// One sentence under the title.
    pub note: String,
    /// Label of the x axis, with its unit.
    pub x_label: String,
    /// Label of the y axis, with its unit.
    pub y_label: String,
    /// The curves.
    pub series: Vec<Series>,
    /// Shaded parts of the x axis.
    pub shaded: Vec<(f64, f64)>,
    /// Meaning of the shading.
    pub shaded_name: String,
    /// Whether the y axis is logarithmic.
    pub log: bool,
}

/// Escapes text for HTML and SVG.
pub(super) fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Maps values to coordinates in the SVG.
struct Scale {
    x: (f64, f64),
    y: (f64, f64),
    log: bool,
}

impl Scale {
    fn of(plot: &Plot) -> Self {
        let points = || plot.series.iter().flat_map(|s| &s.points).copied();
        let band = || plot.series.iter().flat_map(|s| &s.band).copied();
        let xs = points().map(|p| p.0).chain(band().map(|b| b.0));
        let shades = plot.shaded.iter().flat_map(|&(from, to)| [from, to]);
        let ys = points().map(|p| p.1).chain(band().flat_map(|b| [b.1, b.2]));
        let x = range(xs.chain(shades)).unwrap_or((0.0, 1.0));
        if plot.log {
            let y = range(ys.filter(|&y| y > 0.0).map(f64::log10)).unwrap_or((0.0, 1.0));
            return Self { x: widen(x), y: widen((y.0.floor(), y.1.ceil())), log: true };
        }
        let (low, high) = range(ys).unwrap_or((0.0, 1.0));
        // Values not far above zero are shown from zero.
        let low = if low > 0.0 && low < 0.6 * high { 0.0 } else { low };
        let step = tick_step(low, high);
        let y = ((low / step).floor() * step, (high / step).ceil() * step);
        Self { x: widen(x), y: widen(y), log: false }
    }

    fn x(&self, x: f64) -> f64 {
        LEFT + (x - self.x.0) / (self.x.1 - self.x.0) * (WIDTH - LEFT - RIGHT)
    }

    fn y(&self, y: f64) -> f64 {
        let y = if self.log { y.log10() } else { y };
        let share = (y - self.y.0) / (self.y.1 - self.y.0);
        HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)
    }

    /// Tick values of the y axis.
    fn y_ticks(&self) -> Vec<f64> {
        if self.log {
            let decades = self.y.0.round() as i32..=self.y.1.round() as i32;
            let count = decades.clone().count();
            let within: &[f64] = if count <= 3 { &[1.0, 2.0, 5.0] } else { &[1.0] };
            let mark = |decade| within.iter().map(move |unit| unit * 10f64.powi(decade));
            let marks = decades.step_by(count.div_ceil(7)).flat_map(mark);
            return marks.filter(|mark| mark.log10() <= self.y.1 + 1e-9).collect();
        }
        ticks(self.y)
    }
}

fn range(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.filter(|v| v.is_finite()).fold(None, |range, v| match range {
        None => Some((v, v)),
        Some((low, high)) => Some((f64::min(low, v), f64::max(high, v))),
    })
}

fn widen((low, high): (f64, f64)) -> (f64, f64) {
    if high > low { (low, high) } else { (low - 0.5, high + 0.5) }
}

/// Tick step: 1, 2 or 5 times a power of ten, for about six ticks.
fn tick_step(low: f64, high: f64) -> f64 {
    let rough = ((high - low) / 6.0).max(1e-9);
    let power = 10f64.powf(rough.log10().floor());
    let unit = match rough / power {
        u if u <= 1.4 => 1.0,
        u if u <= 3.0 => 2.0,
        u if u <= 7.0 => 5.0,
        _ => 10.0,
    };
    power * unit
}

pub(super) fn ticks((low, high): (f64, f64)) -> Vec<f64> {
    let step = tick_step(low, high);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// Formats a number for the margin: 10,000 and above in thousands with k.
pub(super) fn tick_text(value: f64) -> String {
    let size = value.abs();
    if (1e4..1e6).contains(&size) {
        return format!("{}k", tick_text(value / 1e3));
    }
    if size != 0.0 && !(1e-3..1e6).contains(&size) {
        return format!("{value:.0e}");
    }
    let text = format!("{value:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

impl Plot {
    /// A `<figure>` with title, legend and SVG.
    pub(super) fn html(&self) -> String {
        format!(
            "<figure><figcaption><h3>{}</h3><p>{}</p>{}</figcaption>\n{}</figure>\n",
            escape(&self.title),
            escape(&self.note),
            self.legend(),
            self.svg()
        )
    }

    fn legend(&self) -> String {
        let mut html = String::from("<ul class=\"legend\">");
        for series in self.series.iter().filter(|s| !s.name.is_empty()) {
            let style = if series.dashed { "dashed" } else { "solid" };
            let colour = colour(series);
            let _ = write!(
                html,
                "<li><i style=\"border-top:3px {style} {colour}\"></i>{}</li>",
                escape(&series.name)
            );
        }
        if !self.shaded.is_empty() {
            let _ = write!(html, "<li><i class=\"shade\"></i>{}</li>", escape(&self.shaded_name));
        }
        html + "</ul>"
    }

    fn svg(&self) -> String {
        let scale = Scale::of(self);
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">\n",
            escape(&self.title)
        );
        for &(from, to) in &self.shaded {
            let (x, end) = (scale.x(from), scale.x(to));
            let (width, height) = ((end - x).max(1.0), HEIGHT - TOP - BOTTOM);
            let _ = writeln!(
                svg,
                "<rect x=\"{x:.1}\" y=\"{TOP}\" width=\"{width:.1}\" height=\"{height}\" \
                 class=\"shade\"/>"
            );
        }
        self.add_axes(&scale, &mut svg);
        for series in &self.series {
            add_band(series, &scale, &mut svg);
        }
        for series in &self.series {
            add_curve(series, &scale, &mut svg);
        }
        svg + "</svg>\n"
    }

    fn add_axes(&self, scale: &Scale, svg: &mut String) {
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        for value in scale.y_ticks() {
            let y = scale.y(value);
            let _ = writeln!(
                svg,
                "<path d=\"M{LEFT} {y:.1}H{right}\" class=\"grid\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 6.0,
                y + 4.0,
                tick_text(value)
            );
        }
        for value in ticks(scale.x) {
            let x = scale.x(value);
            let _ = writeln!(
                svg,
                "<path d=\"M{x:.1} {bottom}v4\" class=\"axis\"/>\
                 <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                bottom + 17.0,
                tick_text(value)
            );
        }
        let (middle_x, middle_y) = ((LEFT + right) / 2.0, (TOP + bottom) / 2.0);
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT} {bottom}H{right}\" class=\"axis\"/>\
             <text x=\"{middle_x}\" y=\"{}\" text-anchor=\"middle\" class=\"label\">{}</text>\
             <text x=\"11\" y=\"{middle_y}\" text-anchor=\"middle\" class=\"label\" \
             transform=\"rotate(-90 11 {middle_y})\">{}</text>",
            HEIGHT - 5.0,
            escape(&self.x_label),
            escape(&self.y_label)
        );
    }
}

fn colour(series: &Series) -> &'static str {
    PALETTE[series.colour % PALETTE.len()]
}

fn add_curve(series: &Series, scale: &Scale, svg: &mut String) {
    let shown = |y: f64| y.is_finite() && (!scale.log || y > 0.0);
    let (mut path, mut pen_down) = (String::new(), false);
    for run in runs(&series.points, |p| p.0) {
        for group in groups(run, series.points.len()) {
            let (x, y) = mean_of(group, |p| [p.0, p.1]).into();
            if shown(y) {
                let command = if pen_down { 'L' } else { 'M' };
                let _ = write!(path, "{command}{:.1} {:.1}", scale.x(x), scale.y(y));
            }
            pen_down = shown(y);
        }
        pen_down = false;
    }
    let dash = if series.dashed { " stroke-dasharray=\"5 3\"" } else { "" };
    let _ =
        writeln!(svg, "<path d=\"{path}\" class=\"curve\" stroke=\"{}\"{dash}/>", colour(series));
}

fn add_band(series: &Series, scale: &Scale, svg: &mut String) {
    let finite = series.band.split(|b| !(b.1.is_finite() && b.2.is_finite()));
    let runs = finite.flat_map(|band| runs(band, |b| b.0));
    for run in runs.filter(|run| run.len() > 1) {
        let groups = groups(run, series.band.len());
        let means: Vec<[f64; 3]> =
            groups.map(|group| mean_of(group, |b| [b.0, b.1, b.2])).collect();
        let low = means.iter().map(|m| (m[0], m[1]));
        let high = means.iter().rev().map(|m| (m[0], m[2]));
        let corners: Vec<String> =
            low.chain(high).map(|(x, y)| format!("{:.1} {:.1}", scale.x(x), scale.y(y))).collect();
        let _ = writeln!(
            svg,
            "<path d=\"M{}Z\" fill=\"{}\" opacity=\"0.16\"/>",
            corners.join("L"),
            colour(series)
        );
    }
}

/// The parts of a curve between times without data.
fn runs<T>(points: &[T], x: impl Fn(&T) -> f64) -> impl Iterator<Item = &[T]> {
    let mut steps: Vec<f64> = points.windows(2).map(|pair| x(&pair[1]) - x(&pair[0])).collect();
    let usual = median(&mut steps).filter(|_| points.len() > MANY_POINTS);
    let most = usual.map_or(f64::INFINITY, |usual| GAP * usual);
    points.chunk_by(move |a, b| x(b) - x(a) <= most)
}

/// Groups of neighbouring points, to limit the number of points of a curve that has so many in `all`.
fn groups<T>(points: &[T], all: usize) -> impl Iterator<Item = &[T]> {
    points.chunks(all.div_ceil(MOST_POINTS).max(1))
}

fn mean_of<T, const N: usize>(group: &[T], values: impl Fn(&T) -> [f64; N]) -> [f64; N] {
    let mut mean = [0.0; N];
    for point in group {
        for (sum, value) in mean.iter_mut().zip(values(point)) {
            *sum += value / group.len() as f64;
        }
    }
    mean
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let text = |low, high| ticks((low, high)).into_iter().map(tick_text).collect::<Vec<_>>();
        assert_eq!(text(0.0, 1.0), ["0", "0.2", "0.4", "0.6", "0.8", "1"]);
        assert_eq!(text(-3.0, 12.0), ["-2", "0", "2", "4", "6", "8", "10", "12"]);
        assert_eq!(text(0.0, 0.02), ["0", "0.005", "0.01", "0.015", "0.02"]);
        assert_eq!(tick_text(1e7), "1e7");
        assert_eq!((tick_text(20_000.0), tick_text(9_000.0)), ("20k".into(), "9000".into()));
    }

    #[test]
    fn values_that_are_not_finite_leave_a_gap_and_none_makes_an_empty_plot() {
        let points = vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0), (3.0, 4.0)];
        let plot = Plot { series: vec![Series { points, ..Series::default() }], ..Plot::default() };
        let svg = plot.svg();
        let curve = svg.lines().find(|line| line.contains("curve")).unwrap();
        assert_eq!((curve.matches('M').count(), curve.matches('L').count()), (2, 1), "{curve}");
        assert!(!svg.contains("NaN") && !Plot::default().svg().contains("NaN"));
    }

    #[test]
    fn times_without_data_leave_a_gap() {
        let frames = || (0..60).filter(|i| !(20..40).contains(i)).map(f64::from);
        let (points, band) = (frames().map(|t| (t, 1.0)), frames().map(|t| (t, 0.0, 2.0)));
        let series = Series { points: points.collect(), band: band.collect(), ..Series::default() };
        let svg = Plot { series: vec![series], ..Plot::default() }.svg();
        let curve = svg.lines().find(|line| line.contains("class=\"curve\"")).unwrap();
        assert_eq!(curve.matches('M').count(), 2, "{curve}");
        assert_eq!(svg.matches("opacity=\"0.16\"").count(), 2);
    }

    #[test]
    fn long_series_are_thinned() {
        let points = (0..36_000).map(|i| (f64::from(i), 1.0)).collect();
        let plot = Plot { series: vec![Series { points, ..Series::default() }], ..Plot::default() };
        assert!(plot.svg().len() < 20_000);
    }
}
