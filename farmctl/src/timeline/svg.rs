//! The timeline as the thesis draws it (figures 5.11 to 5.17): a row for each device, nodes shaded in turn, a bold line
//! for each attempt with dots where it begins and ends, a small mark below where it was planned, a red line for each
//! steal inside a node and a blue one for each between nodes.
//!
//! Everything of one kind is one path, and what falls on the same pixel is drawn once: the size of the picture depends
//! on its area, not on the number of jobs.

use std::{collections::BTreeSet, fmt::Write as _};

use farm_core::{
    coordinator::timeline::{Migration, Outcome, Segment},
    id::{AppId, DeviceIndex, NodeId},
    time::Instant,
};

use super::Chart;

const WIDTH_PX: f64 = 1_200.0;
const LEFT_PX: f64 = 132.0;
const RIGHT_PX: f64 = 24.0;
const TOP_PX: f64 = 64.0;
/// Axis and legend.
const BOTTOM_PX: f64 = 74.0;
/// What all the rows together aim at; the height of one stays between the two bounds.
const ROWS_PX: f64 = 620.0;
const MIN_ROW_PX: f64 = 5.0;
const MAX_ROW_PX: f64 = 22.0;
/// Most devices drawn; the first ones by node.
const MAX_ROWS: usize = 1_024;
/// Most lines of one kind of steal.
const MAX_STEALS: usize = 8_192;
/// Longest label, in characters.
const MAX_LABEL: usize = 18;
/// Longest title, in characters.
const MAX_TITLE: usize = 90;
/// Ticks that the axis aims at.
const TICKS: f64 = 10.0;

/// Okabe and Ito's colours, told apart by everybody: vermilion and blue are for steals, the rest for applications.
const LOCAL: &str = "#d55e00";
const GLOBAL: &str = "#0072b2";
const APPS: [&str; 6] = ["#1a1a1a", "#009e73", "#cc79a7", "#b8860b", "#56b4e9", "#7f7f7f"];
const FAILED: &str = "#b00020";

/// The whole picture.
pub(crate) fn picture(chart: &Chart<'_>) -> String {
    let rows = chart.rows.len().min(MAX_ROWS);
    let frame = Frame {
        chart,
        rows,
        row_px: (ROWS_PX / rows.max(1) as f64).clamp(MIN_ROW_PX, MAX_ROW_PX),
        span_s: if chart.span_s() > 0.0 { chart.span_s() } else { 1.0 },
    };
    let bottom = frame.bottom();
    let height = bottom + BOTTOM_PX;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH_PX} {height:.0}\" width=\"{WIDTH_PX}\" \
         height=\"{height:.0}\" font-family=\"Helvetica, Arial, sans-serif\" font-size=\"11\" fill=\"#333\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    frame.nodes(&mut svg);
    frame.axis(&mut svg);
    let thinned = frame.steals(&mut svg) | frame.jobs(&mut svg);
    frame.title(&mut svg, thinned);
    frame.legend(&mut svg);
    svg.push_str("</svg>\n");
    svg
}

struct Frame<'a> {
    chart: &'a Chart<'a>,
    rows: usize,
    row_px: f64,
    span_s: f64,
}

impl Frame<'_> {
    fn bottom(&self) -> f64 {
        TOP_PX + self.rows.max(1) as f64 * self.row_px
    }

    fn x(&self, at: Instant) -> f64 {
        LEFT_PX + self.chart.at_s(at) / self.span_s * (WIDTH_PX - LEFT_PX - RIGHT_PX)
    }

    /// The middle of a device's row; `None` for one that is not drawn.
    fn y(&self, node: NodeId, device: DeviceIndex) -> Option<f64> {
        let row = self.chart.rows.get(&(node, device)).copied().filter(|row| *row < self.rows)?;
        Some(TOP_PX + (row as f64 + 0.42) * self.row_px)
    }

    /// Bands and labels, a node each.
    fn nodes(&self, svg: &mut String) {
        let devices: Vec<(NodeId, DeviceIndex)> = self.chart.rows.keys().copied().take(self.rows).collect();
        let mut row = 0;
        for (index, group) in devices.chunk_by(|one, next| one.0 == next.0).enumerate() {
            let (y, height) = (TOP_PX + row as f64 * self.row_px, group.len() as f64 * self.row_px);
            let shade = ["#eceff3", "#ffffff"][index % 2];
            let _ = writeln!(
                svg,
                "<rect x=\"{LEFT_PX}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{height:.1}\" fill=\"{shade}\"/>",
                WIDTH_PX - LEFT_PX - RIGHT_PX
            );
            // With the lowest rows only what keeps apart from its neighbour is legible.
            if height >= 9.0 {
                let name = escape(&self.chart.node_name(group[0].0), MAX_LABEL);
                let _ = writeln!(
                    svg,
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{name}</text>",
                    LEFT_PX - 24.0,
                    y + height / 2.0 + 4.0
                );
            }
            if self.row_px >= 9.0 {
                for (offset, (_, device)) in group.iter().enumerate() {
                    let _ = writeln!(
                        svg,
                        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" font-size=\"8\" fill=\"#777\">{}</text>",
                        LEFT_PX - 6.0,
                        y + (offset as f64 + 0.5) * self.row_px + 3.0,
                        device.0
                    );
                }
            }
            row += group.len();
        }
    }

    fn axis(&self, svg: &mut String) {
        let (unit, per_s) = unit(self.span_s);
        let step = nice_step(self.span_s * per_s / TICKS);
        let last = (self.span_s * per_s / step).floor();
        let bottom = self.bottom();
        let mut grid = String::new();
        let mut tick = 0.0;
        while tick <= last {
            let x = LEFT_PX + tick * step / (self.span_s * per_s) * (WIDTH_PX - LEFT_PX - RIGHT_PX);
            let _ = write!(grid, "M{x:.1} {TOP_PX}V{:.1}", bottom + 4.0);
            let label = (tick * step * 1e6).round() / 1e6;
            let _ = writeln!(
                svg,
                "<text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>",
                bottom + 17.0
            );
            tick += 1.0;
        }
        let _ = writeln!(svg, "<path d=\"{grid}\" stroke=\"#c9ced6\" stroke-width=\"0.6\"/>");
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT_PX} {bottom:.1}H{:.1}\" stroke=\"#555\"/><text x=\"{:.1}\" y=\"{:.1}\" \
             text-anchor=\"middle\">time in {unit}</text>",
            WIDTH_PX - RIGHT_PX,
            (LEFT_PX + WIDTH_PX - RIGHT_PX) / 2.0,
            bottom + 33.0
        );
    }

    /// Red and blue lines. Whether some were left out.
    fn steals(&self, svg: &mut String) -> bool {
        let mut thinned = false;
        for (colour, global) in [(LOCAL, false), (GLOBAL, true)] {
            let mut lines = BTreeSet::new();
            for segment in &self.chart.timeline.segments {
                let (from, at) = match segment.migration {
                    Some(Migration::Local { device }) if !global => {
                        ((segment.node, device), segment.staged_at)
                    }
                    Some(Migration::Global { node, device }) if global => {
                        ((node, device), segment.scheduled_at)
                    }
                    Some(_) | None => continue,
                };
                let ends = (self.y(from.0, from.1), self.y(segment.node, segment.device));
                let (Some(from_y), Some(to_y)) = ends else { continue };
                if lines.len() == MAX_STEALS {
                    thinned = true;
                    break;
                }
                let line =
                    format!("M{:.1} {from_y:.1}L{:.1} {to_y:.1}", self.x(at), self.x(segment.started_at));
                thinned |= !lines.insert(line);
            }
            path(svg, &lines.into_iter().collect::<String>(), colour, 0.9, "opacity=\"0.75\"");
        }
        thinned
    }

    /// Attempts, their dots, and when they were planned. Whether some fell together.
    fn jobs(&self, svg: &mut String) -> bool {
        let mut thinned = false;
        let line_px = (self.row_px * 0.2).clamp(1.4, 3.2);
        let dot_px = (self.row_px * 0.36).clamp(2.0, 5.2);
        for (app, colour) in self.colours() {
            let mut ordered: Vec<(&Segment, f64)> = self.of(app, Outcome::Completed);
            ordered.sort_by_key(|(segment, _)| (segment.node, segment.device, segment.started_at));
            let (mut lines, mut dots, mut marks) = (String::new(), String::new(), BTreeSet::new());
            let mut drawn: Option<(f64, f64)> = None;
            for (segment, y) in ordered {
                let planned = format!("M{:.0} {:.1}h0", self.x(segment.scheduled_at), y + 0.36 * self.row_px);
                marks.insert(planned);
                let (from, to) = (self.x(segment.started_at), self.x(segment.ended_at));
                // Less than a pixel beyond what is there already shows nothing new.
                if drawn.is_some_and(|(row, until)| row.total_cmp(&y).is_eq() && to < until + 1.0) {
                    thinned = true;
                    continue;
                }
                drawn = Some((y, to));
                let _ = write!(lines, "M{from:.1} {y:.1}H{to:.1}");
                let _ = write!(dots, "M{from:.1} {y:.1}h0M{to:.1} {y:.1}h0");
            }
            path(
                svg,
                &marks.into_iter().collect::<String>(),
                colour,
                dot_px * 0.5,
                "opacity=\"0.55\" stroke-linecap=\"round\"",
            );
            path(svg, &lines, colour, line_px, "");
            path(svg, &dots, colour, dot_px, "stroke-linecap=\"round\"");
            let crosses: BTreeSet<String> = self
                .of(app, Outcome::Failed)
                .into_iter()
                .map(|(segment, y)| {
                    format!("M{:.0} {:.1}l4 4m0-4l-4 4", self.x(segment.ended_at) - 2.0, y - 2.0)
                })
                .collect();
            path(svg, &crosses.into_iter().collect::<String>(), FAILED, 1.4, "");
        }
        thinned
    }

    fn of(&self, app: AppId, outcome: Outcome) -> Vec<(&Segment, f64)> {
        let segments = self.chart.timeline.segments.iter();
        segments
            .filter(|segment| segment.job.job.app == app && segment.outcome == outcome)
            .filter_map(|segment| Some((segment, self.y(segment.node, segment.device)?)))
            .collect()
    }

    fn colours(&self) -> Vec<(AppId, &'static str)> {
        self.chart.apps().into_iter().zip(APPS.into_iter().cycle()).collect()
    }

    fn title(&self, svg: &mut String, thinned: bool) {
        let timeline = self.chart.timeline;
        let apps: Vec<String> = self.chart.apps().into_iter().map(|app| self.chart.app_name(app)).collect();
        let title = if apps.is_empty() { "Nothing ran".to_owned() } else { apps.join(", ") };
        let (unit, per_s) = unit(self.chart.span_s());
        let mut facts = format!(
            "{} jobs on {} devices, {:.3} {unit}, devices {:.1} % busy",
            timeline.segments.len(),
            self.chart.rows.len(),
            self.chart.span_s() * per_s,
            100.0 * self.chart.utilisation()
        );
        let missing = timeline.head.omitted_segments;
        if missing > 0 {
            let _ = write!(facts, "; {missing} older jobs are not in it");
        }
        if self.chart.rows.len() > self.rows {
            let _ = write!(facts, "; the first {} devices are drawn", self.rows);
        }
        if thinned {
            facts.push_str("; thinned: what is less than a pixel apart is drawn as one");
        }
        let _ = writeln!(
            svg,
            "<text x=\"{LEFT_PX}\" y=\"28\" font-size=\"16\" font-weight=\"bold\" fill=\"#111\">{}</text>\n\
             <text x=\"{LEFT_PX}\" y=\"48\">{facts}</text>",
            escape(&title, MAX_TITLE)
        );
    }

    fn legend(&self, svg: &mut String) {
        let y = self.bottom() + 56.0;
        let mut x = LEFT_PX;
        let mut entry = |svg: &mut String, sample: String, text: &str, width: f64| {
            let _ = writeln!(
                svg,
                "<g transform=\"translate({x:.0} {y:.0})\">{sample}<text x=\"30\" y=\"4\">{text}</text></g>"
            );
            x += width;
        };
        for (app, colour) in self.colours().into_iter().take(4) {
            let sample = format!(
                "<path d=\"M2 0H24\" stroke=\"{colour}\" stroke-width=\"3\"/><path d=\"M2 0h0M24 0h0\" \
                 stroke=\"{colour}\" stroke-width=\"5\" stroke-linecap=\"round\"/>"
            );
            entry(svg, sample, &escape(&self.chart.app_name(app), 22), 170.0);
        }
        let mark = "<path d=\"M13 0h0\" stroke=\"#1a1a1a\" opacity=\"0.55\" stroke-width=\"3\" stroke-linecap=\"round\"/>";
        entry(svg, mark.to_owned(), "planned", 90.0);
        for (colour, text) in [(LOCAL, "stolen inside a node"), (GLOBAL, "stolen between nodes")] {
            entry(svg, format!("<path d=\"M4 5L22-5\" stroke=\"{colour}\"/>"), text, 155.0);
        }
    }
}

fn path(svg: &mut String, data: &str, colour: &str, width_px: f64, more: &str) {
    if !data.is_empty() {
        let _ = writeln!(
            svg,
            "<path d=\"{data}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width_px:.1}\" {more}/>"
        );
    }
}

/// The unit in which a span reads well, and how many of it make a second.
fn unit(span_s: f64) -> (&'static str, f64) {
    match span_s {
        7_200.0.. => ("h", 1.0 / 3_600.0),
        1.0.. => ("s", 1.0),
        0.001.. => ("ms", 1e3),
        _ => ("\u{b5}s", 1e6),
    }
}

/// The least of 1, 2, 5 times a power of ten that is not below `least`.
fn nice_step(least: f64) -> f64 {
    let power = 10_f64.powf(least.log10().floor());
    [1.0, 2.0, 5.0].map(|step| step * power).into_iter().find(|step| *step >= least).unwrap_or(10.0 * power)
}

/// Text from elsewhere, fit for XML and cut: no mark-up, no control characters, nothing that turns the writing around.
fn escape(text: &str, most: usize) -> String {
    let mut safe = String::new();
    for (index, c) in text.chars().enumerate() {
        if index == most {
            safe.push('\u{2026}');
            break;
        }
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&apos;"),
            '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                safe.push('\u{fffd}')
            }
            '\u{fffe}' | '\u{ffff}' => safe.push('\u{fffd}'),
            c if c.is_control() => safe.push('\u{fffd}'),
            c => safe.push(c),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::timeline::samples::{segment, timeline};

    /// Tags nest and are closed, attributes are quoted, and no character is there that XML does not have.
    fn is_well_formed(svg: &str) -> bool {
        let mut open = Vec::new();
        let mut rest = svg;
        while let Some(at) = rest.find('<') {
            let (text, tag) = rest.split_at(at);
            let Some(end) = tag.find('>') else { return false };
            let tag_text = &tag[1..end];
            if text.contains('>') || tag_text.matches('"').count() % 2 != 0 || tag_text.contains('<') {
                return false;
            }
            match tag_text.strip_prefix('/') {
                Some(name) if open.pop() != Some(name) => return false,
                Some(_) => {}
                None if tag_text.ends_with('/') => {}
                None => open.push(tag_text.split_whitespace().next().unwrap_or_default()),
            }
            rest = &tag[end + 1..];
        }
        open.is_empty() && !svg.chars().any(|c| c.is_control() && c != '\n')
    }

    #[test]
    fn the_check_tells_bad_from_good() {
        assert!(is_well_formed("<a b=\"c\"><d/></a>"));
        for bad in ["<a>", "<a></b>", "<a b=\"></a>", "<a>\u{7}</a>", "<a>></a>"] {
            assert!(!is_well_formed(bad), "{bad:?}");
        }
    }

    #[test]
    fn an_empty_timeline_and_one_job_are_pictures() {
        for segments in [Vec::new(), vec![segment(1, 0, 0, None)]] {
            let timeline = timeline("w", segments);
            let svg = picture(&Chart::new(&timeline));
            assert!(is_well_formed(&svg) && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn hostile_names_stay_text() {
        let timeline =
            timeline("<script>\"'&\u{202e}\u{1b}[2J", vec![segment(1, 0, 0, None), segment(2, 1, 1, None)]);
        let svg = picture(&Chart::new(&timeline));
        assert!(is_well_formed(&svg), "{svg}");
        assert!(svg.contains("&lt;script&gt;"), "{svg}");
        assert!(!svg.contains("<script") && !svg.contains('\u{202e}') && !svg.contains('\u{1b}'), "{svg}");
    }

    #[test]
    fn steals_are_red_inside_a_node_and_blue_between_nodes() {
        let local = Some(Migration::Local { device: DeviceIndex(1) });
        let global = Some(Migration::Global { node: NodeId(1), device: DeviceIndex(1) });
        let strokes = |segments| {
            let timeline = timeline("w", segments);
            let svg = picture(&Chart::new(&timeline));
            // The legend has each once.
            (svg.matches(LOCAL).count() - 1, svg.matches(GLOBAL).count() - 1)
        };
        assert_eq!(strokes(vec![segment(2, 0, 0, None)]), (0, 0));
        assert_eq!(strokes(vec![segment(2, 0, 0, local)]), (1, 0));
        assert_eq!(strokes(vec![segment(2, 0, 0, global)]), (0, 1));
    }

    #[test]
    fn times_out_of_order_are_drawn_inside_the_picture() {
        let mut odd = segment(1, 0, 3, None);
        (odd.staged_at, odd.ended_at) = (Instant(u64::MAX), Instant(0));
        let timeline = timeline("w", vec![odd, segment(1, 0, 1, None)]);
        let svg = picture(&Chart::new(&timeline));
        assert!(is_well_formed(&svg) && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }

    #[test]
    fn a_hundred_thousand_jobs_make_no_large_picture_and_it_says_so() {
        let segments: Vec<Segment> = (0..100_000).map(|index| segment(1, 0, index, None)).collect();
        let timeline = timeline("w", segments);
        let svg = picture(&Chart::new(&timeline));
        assert!(svg.len() < 200_000, "{} bytes", svg.len());
        assert!(svg.contains("thinned"), "said in the picture");
    }

    #[test]
    fn steps_are_round() {
        for (least, step) in [(0.9, 1.0), (1.1, 2.0), (3.0, 5.0), (6.0, 10.0), (0.03, 0.05)] {
            assert!((nice_step(least) - step).abs() < 1e-9, "{least}: {}", nice_step(least));
        }
    }
}
