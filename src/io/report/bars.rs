//! Horizontal bars as SVG: groups by name, one bar per series.

use std::fmt::Write as _;

use super::plot::{PALETTE, escape, tick_text, ticks};

/// Coordinates inside the SVG; the page scales it.
const WIDTH: f64 = 460.0;
const LEFT: f64 = 150.0;
const RIGHT: f64 = 46.0;
const BAR: f64 = 13.0;
const GAP: f64 = 9.0;
const BOTTOM: f64 = 36.0;

/// A group of bars per name, with one bar per series.
#[derive(Clone, Debug, Default)]
pub struct Bars {
    /// Heading.
    pub title: String,
    /// One sentence under the title.
    pub note: String,
    /// Measured quantity with its unit.
    pub label: String,
    /// Names of the series.
    pub series: Vec<String>,
    /// Name and one value per series; values that are not finite have no bar.
    pub groups: Vec<(String, Vec<f64>)>,
}

impl Bars {
    /// A `<figure>` with title, legend and SVG.
    pub(super) fn html(&self) -> String {
        let items = self.series.iter().enumerate().map(|(index, name)| {
            let colour = PALETTE[index % PALETTE.len()];
            let style = format!("border-top:9px solid {colour}");
            format!("<li><i style=\"{style}\"></i>{}</li>", escape(name))
        });
        format!(
            "<figure><figcaption><h3>{}</h3><p>{}</p><ul class=\"legend\">{}</ul></figcaption>\n\
             {}</figure>\n",
            escape(&self.title),
            escape(&self.note),
            items.collect::<String>(),
            self.svg()
        )
    }

    fn svg(&self) -> String {
        let group = self.series.len().max(1) as f64 * BAR + GAP;
        let bottom = GAP + group * self.groups.len() as f64;
        let values = self.groups.iter().flat_map(|(_, values)| values);
        let most = values.copied().filter(|value| value.is_finite()).fold(0.0, f64::max);
        let most = if most > 0.0 { most } else { 1.0 };
        let x = |value: f64| LEFT + value / most * (WIDTH - LEFT - RIGHT);
        let mut svg = format!(
            "<svg viewBox=\"0 0 {WIDTH} {}\" role=\"img\" aria-label=\"{}\">\n",
            bottom + BOTTOM,
            escape(&self.title)
        );
        for mark in ticks((0.0, most)) {
            let _ = writeln!(
                svg,
                "<path d=\"M{at:.1} {GAP}V{bottom}\" class=\"grid\"/>\
                 <text x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                bottom + 15.0,
                tick_text(mark),
                at = x(mark)
            );
        }
        for (index, (name, values)) in self.groups.iter().enumerate() {
            let top = GAP + index as f64 * group;
            let middle = top + 0.5 * (group - GAP) + 4.0;
            let _ = writeln!(
                svg,
                "<text x=\"{}\" y=\"{middle:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 6.0,
                escape(name)
            );
            for (series, &value) in values.iter().enumerate().filter(|(_, v)| v.is_finite()) {
                let y = top + series as f64 * BAR;
                let _ = writeln!(
                    svg,
                    "<rect x=\"{LEFT}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{}\" fill=\"{}\"/>\
                     <text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                    (x(value) - LEFT).max(0.0),
                    BAR - 1.5,
                    PALETTE[series % PALETTE.len()],
                    x(value) + 4.0,
                    y + BAR - 3.0,
                    value_text(value)
                );
            }
        }
        let middle = 0.5 * (LEFT + WIDTH - RIGHT);
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT} {GAP}V{bottom}\" class=\"axis\"/>\
             <text x=\"{middle}\" y=\"{}\" text-anchor=\"middle\" class=\"label\">{}</text>",
            bottom + 31.0,
            escape(&self.label)
        );
        svg + "</svg>\n"
    }
}

/// Formats a value with three digits.
fn value_text(value: f64) -> String {
    match value.abs() {
        size if size >= 99.95 => format!("{value:.0}"),
        size if size >= 9.995 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bar_for_each_value_that_is_one() {
        let bars = Bars {
            series: vec!["x".into(), "y".into()],
            groups: vec![("a<b".into(), vec![10.0, 20.0]), ("c".into(), vec![f64::NAN, 5.0])],
            ..Bars::default()
        };
        let svg = bars.svg();
        assert_eq!(svg.matches("<rect").count(), 3);
        assert!(svg.contains("a&lt;b") && !svg.contains("NaN"));
        assert!(!Bars::default().svg().contains("NaN"));
        assert_eq!([12.34, 123.4, 1.234].map(value_text), ["12.3", "123", "1.23"]);
    }
}
