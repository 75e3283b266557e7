//! Tests the time axis. It shows dates if the record has them. Otherwise, it shows the time since the start in a unit
//! that suits the record's length.

use super::*;
use crate::chart::Size;
use crate::report::{examples, page};

fn texts<'a>(svg: &'a str, class: &str) -> Vec<&'a str> {
    let start = format!("class=\"{class}\">");
    svg.split(&start).skip(1).filter_map(|rest| rest.split('<').next()).collect()
}

fn x_axis(picture: &Picture) -> (Vec<String>, String) {
    let svg = picture.draw(Size::WIDE).0;
    let after_ticks = svg.rsplit("class=\"t m\">").next().expect("ticks");
    let caption = texts(after_ticks, "t e").first().map(|caption| (*caption).to_owned());
    (texts(&svg, "t m").into_iter().map(str::to_owned).collect(), caption.expect("a caption"))
}

fn x_axes(data: &Data) -> Vec<(Vec<String>, String)> {
    let pictures = all(data, &PageContext::default());
    let names: Vec<&str> = pictures.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["soc", "temperature", "innovation", "coverage"]);
    pictures.iter().map(|(_, picture)| x_axis(picture)).collect()
}

#[test]
fn undated_recording_counts_seconds_since_its_start() {
    let data = examples::recording(1000.0, 60.0);
    for (ticks, caption) in x_axes(&data) {
        assert_eq!(ticks, ["0", "10", "20", "30", "40", "50", "60"]);
        assert_eq!(caption, "time since the start, s");
    }
    let Some(Picture::Chart(chart)) = coverage(&data) else { panic!("a chart") };
    let Shape::Line(points) = &chart.layers[0].shape else { panic!("a line") };
    let ends = (points[0].0, points[points.len() - 1].0);
    assert!(
        (0.0..=1.0).contains(&ends.0) && (59.0..=61.0).contains(&ends.1),
        "the values lie at their ticks: {ends:?}"
    );
    assert!(!page(&data, &PageContext::default()).contains("UTC"));
}

#[test]
fn dated_life_has_ticks_of_utc_dates() {
    use crate::quantity::DAY_S;
    // The recording starts at 2023-11-14T22:13:20Z.
    for (ticks, caption) in x_axes(&examples::recording(1.7e9, 10.0 * DAY_S)) {
        assert_eq!(ticks, ["11-15", "11-16", "11-17", "11-18", "11-19", "11-20", "11-21", "11-22", "11-23", "11-24"]);
        assert_eq!(caption, "UTC, 2023-11-14 to 2023-11-24");
    }
    // A short recording also has dates.
    for (ticks, caption) in x_axes(&examples::recording(1.7e9, 60.0)) {
        assert_eq!(ticks, ["22:13:30", "22:13:45", "22:14:00", "22:14:15"]);
        assert_eq!(caption, "UTC, 2023-11-14 to 2023-11-14");
    }
    let page = page(&examples::recording(1.7e9, 10.0 * DAY_S), &PageContext::default());
    assert!(page.contains("2023-11-14 22:13:20 UTC to 2023-11-24 22:13:20 UTC (10 days)"));
    assert!(page.contains(">UTC, 2023-11-14 to 2023-11-24<") && !page.contains("time since the start"));
}

#[test]
fn unit_of_an_undated_axis_suits_its_length() {
    let cases = [
        (60.0, "s", 60.0),
        (599.0, "s", 599.0),
        (601.2, "min", 10.02),
        (14_364.0, "min", 239.4),
        (14_436.0, "h", 4.01),
        (345_240.0, "h", 95.9),
        (346_464.0, "days", 4.01),
    ];
    for (length_s, unit, length) in cases {
        let clock = TimeAxis::of(&examples::recording(1000.0, length_s));
        assert_eq!(clock.axis.label, format!("time since the start, {unit}"), "{length_s} s");
        assert_eq!(clock.axis.scale, Scale::Number);
        let (low, high) = clock.axis.range.expect("a range");
        assert!(low == 0.0 && (high - length).abs() < 1e-6, "{length_s} s: 0 to {high} {unit}");
        assert!((clock.x(1000.0 + length_s) - length).abs() < 1e-6, "{length_s} s");
    }
}

#[test]
fn part_of_an_undated_record_counts_from_its_start() {
    let clock = TimeAxis::between(&examples::recording(1000.0, 7200.0), 8140.0, 8200.0);
    assert_eq!((clock.axis.label.as_str(), clock.axis.range), ("time since the start, s", Some((7140.0, 7200.0))));
    assert_eq!(clock.x(8170.0), 7170.0);
}
