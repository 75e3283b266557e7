//! Renders the report as one HTML page that contains its style and pictures, without scripts or external resources.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::context::PageContext;
use super::data::{Data, Origin};
use super::known::Knowledge;
use super::pictures::{self, NOT_STORED};
use super::{forecast, format, model, summary, usage};
use crate::chart::{Picture, Size, variables};
use crate::config::Config;
use crate::{cell_fault_pictures, pack_view};

const MAX_ROWS: usize = 200;

const ALARMS_AFTER: &str = "temperature";

struct Section {
    id: &'static str,
    title: &'static str,
    pictures: &'static [&'static str],
    note: &'static str,
    none: fn(&Data) -> &'static str,
}

const SECTIONS: [Section; 8] = [
    Section {
        id: "findings",
        title: "The cells compared",
        pictures: &cell_fault_pictures::NAMES,
        note: "Each cell relative to the median of its pack. All cells carry the same current, so common effects cancel. A bar is a \
               95 % interval. A cell beyond the limit is reported if it also stands out from the others and lasts.",
        none: |data| {
            if data.cells() < 3 {
                "fewer than three cells: there is no median to compare with"
            } else {
                "unknown: there is no state of the cells"
            }
        },
    },
    Section {
        id: "soc",
        title: "State of charge",
        pictures: &["soc"],
        note: "How full the battery was. According to the estimator, the light band contains the truth 95 % of the time. In a long record \
               each pixel column shows the lowest and the highest value within it.",
        none: |data| if data.source.origin == Origin::Store { NOT_STORED } else { "unknown: no estimate was made" },
    },
    Section {
        id: "capacity",
        title: "Capacity",
        pictures: &["capacity", "usable_capacity", "losses"],
        note: "Capacity is the charge between the full and the empty cell at rest. Usable capacity is the charge available at a \
               load; it also falls when the resistance rises. A pack is as good as its weakest cell. How a loss of capacity divides \
               into lithium and active material is mostly an assumption, which the interval includes.",
        none: |_| "unknown: no charge or discharge has measured the capacity yet",
    },
    Section {
        id: "recharge",
        title: "Recharge period",
        pictures: &["recharge_period"],
        note: "A worn battery is full sooner. The normalised period is the time the reference charger would need, so that a strong \
               charger does not look like a worn battery.",
        none: |_| "unknown: no charge covered enough of the window",
    },
    Section {
        id: "resistance",
        title: "Resistance",
        pictures: &["resistance"],
        note: "Grows with age: the battery delivers less power and heats up more.",
        none: |_| "unknown: not learned yet",
    },
    Section {
        id: "temperature",
        title: "Temperature",
        pictures: &["temperature"],
        note: "",
        none: |_| "unknown: no temperature was measured",
    },
    Section {
        id: "model",
        title: "How well the battery is known",
        pictures: &["model_curve", "model_resistance", "model_temperature", "model_soc_error"],
        note: "The model that converts voltages to a state of charge. A cell of this kind lies within the bands 95 % of the time. \
               Dashed lines were not measured.",
        none: |_| "unknown: create the report with the configuration (-c), which names the cells",
    },
    Section {
        id: "estimator",
        title: "Health of the estimator",
        pictures: &["innovation", "coverage"],
        note: "Whether the figures above can be trusted: the innovation is the measured minus the expected voltage, and 95 % of \
               the innovations should lie within the interval that the filter itself states.",
        none: |data| if data.source.origin == Origin::Store { NOT_STORED } else { "unknown: no voltage was compared" },
    },
];

/// Renders the page as HTML.
pub fn page(data: &Data, context: &PageContext<'_>) -> String {
    let outlook = forecast::outlook(data, context);
    let summary = summary::of(data, context, &outlook);
    let mut pictures = pictures::all(data, context);
    let quiet = context.diagnosis.map(cell_fault_pictures::quiet).unwrap_or_default();
    pictures.retain(|(name, _)| quiet.iter().all(|picture| picture.0 != name));
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            (head(&context.title))
            body {
                main {
                    (heading(data, context))
                    (verdict(&summary))
                    (knowledge_of(&summary.knowledge))
                    @for section in &SECTIONS {
                        (self::section(section, data, &pictures))
                        @match section.id {
                            "capacity" => { (forecast_note(data, &outlook)) }
                            ALARMS_AFTER => { (use_of(context)) (alarms(data, &pictures)) }
                            "findings" => { (cost(context, &quiet)) }
                            "model" => { (knowledge(data, context)) }
                            "estimator" => { (estimator(data)) }
                            _ => {}
                        }
                    }
                    (origin(data, context))
                }
            }
        }
    };
    page.into_string()
}

fn head(title: &str) -> Markup {
    html! {
        head {
            meta charset="utf-8";
            meta name="viewport" content="width=device-width,initial-scale=1";
            meta http-equiv="Content-Security-Policy"
                content="default-src 'none'; style-src 'unsafe-inline'; img-src data:";
            link rel="icon" href="data:,";
            title { (title) }
            style { (PreEscaped(variables())) (PreEscaped(include_str!("page.css"))) }
        }
    }
}

fn heading(data: &Data, context: &PageContext<'_>) -> Markup {
    let pack = data.source.pack.map_or_else(String::new, |pack| format!("pack {pack} of this history, "));
    let cells = match data.cells() {
        0 => "cells unknown".to_owned(),
        1 => "one cell".to_owned(),
        cells => format!("{cells} cells"),
    };
    let links = SECTIONS.iter().flat_map(|section| {
        let is_before = section.id == ALARMS_AFTER;
        let more = [("use", "Use"), ("alarms", "Alarms")].into_iter().filter(move |_| is_before);
        [(section.id, section.title)].into_iter().chain(more)
    });
    html! {
        h1 { (context.title) }
        p.soft { "Battery report, " (pack) (cells) ", " (span(data)) ". Every \u{b1} is one standard deviation." }
        nav {
            @for (id, title) in [("known", "Known"), ("unknown", "Not known")].into_iter().chain(links).chain([("origin", "Origin")]) {
                a href={ "#" (id) } { (title) }
            }
        }
    }
}

fn span(data: &Data) -> String {
    let Some((first_s, last_s)) = data.ends_s() else { return "there is no record".to_owned() };
    let long = format::length(last_s - first_s);
    match data.is_dated() {
        true => format!("{} to {} ({long})", format::moment(data, first_s), format::moment(data, last_s)),
        false => long,
    }
}

fn verdict(summary: &summary::Summary) -> Markup {
    html! {
        section class={ "verdict " (summary.condition.class()) } aria-label="Summary" {
            div.sign aria-hidden="true" { (summary.condition.sign()) }
            div {
                @for problem in &summary.problems {
                    p.head { (problem.what) }
                    p { span.soft { "What to do: " } (problem.advice) }
                    @if !problem.note.is_empty() { p.soft { (problem.note) } }
                }
            }
        }
    }
}

fn knowledge_of(knowledge: &Knowledge) -> Markup {
    html! {
        section {
            h2 #known { "What is known" }
            div.tiles {
                @for tile in &knowledge.tiles {
                    div.tile {
                        div.name { (tile.name) }
                        div.value { (tile.value) }
                        div.note { (tile.note) }
                        @if let Some(doubt) = &tile.doubt { div.doubt { (doubt) } }
                    }
                }
            }
        }
        section {
            @if knowledge.gaps.is_empty() { p.none #unknown { b { "What is not known:" } " nothing of the above." } } @else {
                h2 #unknown { "What is not known yet" }
                div.scroll {
                    table.gaps {
                        thead { tr { th { "What" } th { "Why" } th { "What would teach it" } } }
                        tbody {
                            @for gap in &knowledge.gaps { tr { td { (gap.name) } td { (gap.why) } td { (gap.teaches) } } }
                        }
                    }
                }
            }
        }
    }
}

fn figure(picture: &Picture) -> Markup {
    html! {
        figure {
            (PreEscaped(picture.inline(Size::WIDE, "wide")))
            (PreEscaped(picture.inline(Size::NARROW, "narrow")))
        }
    }
}

fn section(section: &Section, data: &Data, pictures: &[(String, Picture)]) -> Markup {
    let own = section.pictures.iter().filter_map(|name| pictures.iter().find(|(known, _)| known == name));
    let own: Vec<_> = own.collect();
    if own.is_empty() {
        return empty(section.id, section.title, (section.none)(data));
    }
    html! {
        section {
            h2 id=(section.id) { (section.title) }
            @if !section.note.is_empty() { p.soft { (section.note) } }
            @for (_, picture) in own { (figure(picture)) }
        }
    }
}

fn empty(id: &str, title: &str, why: &str) -> Markup {
    html! { section { p.none id=(id) { b { (title) "." } " " (format::capitalised(why)) } } }
}

/// Explains the difference between the learned capacity and the start of the forecast, which is drawn as a fan.
fn gap(data: &Data, outlook: &forecast::Outlook) -> &'static str {
    let last = data.learned.iter().rev().find(|row| row.cell == outlook.cell);
    match (last, outlook.fan.first()) {
        (Some(last), Some(first)) if (first.median_ah - last.capacity_ah.0).abs() > 2.0 * last.capacity_ah.1 => {
            " It starts at the capacity of the latest half-cycles alone; the learned capacity still approaches that value."
        }
        _ => "",
    }
}

fn forecast_note(data: &Data, outlook: &Result<forecast::Outlook, String>) -> Markup {
    let note = match outlook {
        // The beginning of the page states the reason.
        Err(_) => return html! {},
        Ok(outlook) if outlook.is_over() => "No forecast of the capacity: the end of life has passed.".to_owned(),
        Ok(outlook) if outlook.fan.is_empty() => "The forecast has no dates: the rate of use is unknown.".to_owned(),
        Ok(outlook) => fan_note(data, outlook),
    };
    let class = if outlook.as_ref().is_ok_and(|outlook| !outlook.fan.is_empty()) { "soft" } else { "none" };
    html! { p class=(class) { (note) } }
}

fn fan_note(data: &Data, outlook: &forecast::Outlook) -> String {
    let of_cell = if data.cells() > 1 { format!(" for cell {}", outlook.cell + 1) } else { String::new() };
    let doubt = outlook.unknown.as_ref().map_or_else(String::new, |why| {
        format!(" It is the shortest known life; another cell's life may end sooner: {why}.")
    });
    format!(
        "The fan is the forecast{of_cell} at the recent rate of use: in one of two cases, the end of life comes before the \
         dashed line meets it; in nine of ten, within the band.{}{doubt}",
        gap(data, outlook)
    )
}

fn use_of(context: &PageContext<'_>) -> Markup {
    let Some(record) = &context.use_record else {
        return empty("use", "Use", "unknown: the state of the pack is missing");
    };
    html! {
        section {
            h2 #use { "Use" }
            p.soft { "Counted while the program received data. An event is at least 1 s beyond a limit; the next needs 10 s within it." }
            (table(&["", "Time beyond", "Events", "Time known", "Time unknown", "Most extreme"], usage::limits(record), 6))
            (pairs(&usage::rows(record)))
        }
    }
}

fn alarms(data: &Data, pictures: &[(String, Picture)]) -> Markup {
    if data.alarms.is_empty() && data.incidents.is_empty() {
        return empty("alarms", "Alarms", "no alarm was raised in this record");
    }
    let incidents = data.incidents.iter().rev();
    let incidents = incidents.map(|(time_s, what)| vec![format::moment(data, *time_s), what.clone()]);
    let list = match data.source.origin {
        Origin::Store => "packwatch history --kind alarm",
        Origin::Replay => "packwatch replay --events",
    };
    html! {
        section {
            h2 #alarms { "Alarms" }
            p.soft { "A bar is an alarm from when it was raised until it ended. " (list) " lists every change." }
            @if let Some((_, picture)) = pictures.iter().find(|(name, _)| name == "alarms") { (figure(picture)) }
            @if !data.incidents.is_empty() {
                h3 { "Other events" }
                (table(&["When", "What"], incidents, data.incidents.len()))
            }
        }
    }
}

/// Renders the first [`MAX_ROWS`] of `count` rows, with a note if there are more.
fn table(names: &[&str], rows: impl Iterator<Item = Vec<String>>, count: usize) -> Markup {
    html! {
        div.scroll {
            table.log {
                thead { tr { @for name in names { th { (name) } } } }
                tbody {
                    @for row in rows.take(MAX_ROWS) {
                        tr { @for cell in row { td.n { (cell) } } }
                    }
                }
            }
        }
        @if count > MAX_ROWS {
            p.soft { "the latest " (MAX_ROWS) " of " (count) }
        }
    }
}

fn cost(context: &PageContext<'_>, quiet: &[(&str, &str)]) -> Markup {
    let Some(imbalance) = &context.imbalance else { return html! {} };
    let titles: Vec<String> = quiet.iter().map(|(_, title)| title.to_lowercase()).collect();
    html! {
        @if !titles.is_empty() {
            p.soft { "No cell stands out in: " (titles.join(", ")) ". packwatch diagnose --plots draws these, too." }
        }
        h3 { "Cost of the differences between the cells for the pack" }
        (pairs(&pack_view::lines(imbalance, context.model.as_ref().map(|sourced| &sourced.model))))
    }
}

fn knowledge(data: &Data, context: &PageContext<'_>) -> Markup {
    let rows = model::rows(data, context);
    let advice = model::advice(context);
    html! {
        @if !rows.is_empty() {
            (pairs(&rows))
            h3 { "Measurements that would help most" }
            @match advice.as_deref() {
                None => { p.none { "unknown: the model states no error; packwatch fit writes a model that does" } }
                Some([]) => { p.soft { "No single measurement would make the state of charge much more certain." } }
                Some(advice) => { ol { @for sentence in advice { li { (sentence) } } } }
            }
        }
        @if !data.models.is_empty() {
            h3 { "Learned changes of the model" }
            (table(&["When", "State", "Capacity", "Residuals", ""], model::changes(data), data.models.len()))
        }
    }
}

fn estimator(data: &Data) -> Markup {
    let health = data.trace.health();
    let (Some(coverage), Some(nis)) = (health.coverage(), health.mean_nis()) else { return html! {} };
    let worst = data.trace.cells.iter().enumerate().filter_map(|(cell, health)| Some((cell, health.coverage()?)));
    let worst = worst.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|_| data.cells() > 1);
    let mut rows = vec![
        ("Voltage readings compared".to_owned(), grouped(health.count)),
        ("Within the filter's own 95 % interval".to_owned(), format!("{:.1} %", 100.0 * coverage)),
        ("Mean normalised innovation squared (1 = as expected)".to_owned(), format!("{nis:.2}")),
        ("Rejected by the gate".to_owned(), grouped(health.gated)),
    ];
    rows.extend(
        worst.map(|(cell, share)| {
            ("Least covered cell".to_owned(), format!("cell {}: {:.1} %", cell + 1, 100.0 * share))
        }),
    );
    rows.extend(data.current_offset.map(|(mean, std)| {
        ("Offset of the current sensor: reading minus true current".to_owned(), {
            let mean = format::without_minus_zero(format!("{mean:+.3}"));
            format!("{mean} \u{b1} {std:.3} A")
        })
    }));
    pairs(&rows)
}

fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let groups: Vec<&[u8]> = digits.as_bytes().rchunks(3).rev().collect();
    groups.iter().map(|group| String::from_utf8_lossy(group)).collect::<Vec<_>>().join("\u{202f}")
}

fn pairs(rows: &[(String, String)]) -> Markup {
    html! {
        div.scroll {
            table.kv {
                tbody { @for (name, value) in rows { tr { td { (name) } td { (value) } } } }
            }
        }
    }
}

fn origin(data: &Data, context: &PageContext<'_>) -> Markup {
    let mut rows = vec![("Program".to_owned(), concat!("packwatch ", env!("CARGO_PKG_VERSION")).to_owned())];
    rows.extend(context.provenance.iter().cloned());
    rows.extend(data.source.pack.map(|pack| {
        ("Pack of this history".to_owned(), format!("{pack} (the latest; earlier ones are in packwatch history)"))
    }));
    rows.extend(context.config.into_iter().flat_map(settings));
    html! {
        section {
            h2 #origin { "Origin of the data" }
            (pairs(&rows))
            @if let Some(text) = &context.config_text {
                details { summary { "The configuration as read" } pre { (text) } }
            }
        }
    }
}

fn settings(config: &Config) -> Vec<(String, String)> {
    let model = &config.monitor.model;
    let capacity = format!("{} Ah (rated {} Ah)", model.capacity_ah, model.rated_capacity_ah);
    let mut rows = vec![
        ("Cell model".to_owned(), model.name.clone()),
        ("Capacity of a new cell, as the cell model assumes".to_owned(), capacity),
        ("Cells".to_owned(), config.monitor.sample.cells.to_string()),
    ];
    rows.extend(config.monitor.rules.iter().map(|rule| {
        let name = rule.rule.name();
        (format!("Limit {name} ({})", rule.severity.name()), format::amount(rule.threshold, name))
    }));
    rows
}

#[cfg(test)]
mod tests;
