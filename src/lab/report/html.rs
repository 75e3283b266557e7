//! The page: one HTML file with its style and pictures in it; no script, nothing fetched.

use super::data::{Data, Origin};
use super::pictures::{self, NOT_STORED};
use super::{PageContext, forecast, summary};
use crate::chart::{Picture, Size, escape, variables};

/// Rows of tables; all is in the pictures, and in `packwatch history`.
const MAX_ROWS: usize = 200;

/// A part of the page.
struct Section {
    id: &'static str,
    title: &'static str,
    /// Names of its pictures.
    pictures: &'static [&'static str],
    /// How to read it.
    note: &'static str,
    /// What is missing when it has no picture.
    none: fn(&Data) -> &'static str,
}

const SECTIONS: [Section; 7] = [
    Section {
        id: "soc",
        title: "State of charge",
        pictures: &["soc", "soc_recent"],
        note: "How full the battery was. The light band holds the truth 95 % of the time, says the estimator. Over a long record \
               each pixel column shows the lowest and the highest value in it.",
        none: |data| if data.source.origin == Origin::Store { NOT_STORED } else { "unknown: no estimate was made" },
    },
    Section {
        id: "capacity",
        title: "Capacity",
        pictures: &["capacity", "usable_capacity"],
        note: "Capacity is the charge between the full and the empty cell at rest; usable capacity is what can be taken out at \
               a load, and also falls when resistance rises. A pack is as good as its weakest cell.",
        none: |_| "unknown: no charge or discharge has taught anything about the capacity yet",
    },
    Section {
        id: "recharge",
        title: "Recharge period",
        pictures: &["recharge_period"],
        note: "A worn battery is full sooner. The normalised period is what the reference charger would need, so that a strong \
               charger does not look like a worn battery.",
        none: |_| "unknown: no charge covered enough of the window",
    },
    Section {
        id: "resistance",
        title: "Resistance",
        pictures: &["resistance"],
        note: "Grows with age: the battery gives less power and heats up more.",
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
        id: "cells",
        title: "Cells",
        pictures: &["cells_capacity", "cells_resistance"],
        note: "Every row is a cell. A row that differs from its neighbours is the cell to look at.",
        none: |data| {
            if data.cells() == 1 { "one cell: see above" } else { "unknown: nothing was learned about the cells yet" }
        },
    },
    Section {
        id: "estimator",
        title: "Health of the estimator",
        pictures: &["innovation", "coverage"],
        note: "Whether the figures above can be believed: the innovation is the measured voltage minus the expected one, and 95 % of \
               them should lie within the interval the filter itself stated.",
        none: |data| if data.source.origin == Origin::Store { NOT_STORED } else { "unknown: no voltage was compared" },
    },
];

const STYLE: &str = "*{box-sizing:border-box}body{margin:0;background:var(--page);color:var(--word);\
font:15px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,'DejaVu Sans',sans-serif}\
main{max-width:1008px;margin:0 auto;padding:24px}h1{font-size:24px;line-height:1.25;margin:0 0 4px;overflow-wrap:anywhere}\
h2{font-size:18px;margin:36px 0 4px;padding-top:12px;border-top:1px solid var(--rule)}\
p{margin:6px 0 10px;max-width:76ch}.soft{color:var(--soft)}nav{margin:10px 0 0;font-size:14px}nav a{display:inline-block;margin-right:14px}\
a{color:var(--blue)}figure{margin:14px 0 18px}svg{display:block;width:100%;height:auto}.narrow{display:none}\
.verdict{display:grid;grid-template-columns:56px 1fr;gap:16px;background:var(--card);border-left:6px solid var(--grey);\
border-radius:6px;padding:16px 18px;margin:18px 0 14px}.verdict .sign{width:52px;height:52px;border-radius:50%;display:flex;align-items:center;\
justify-content:center;font-size:26px;font-weight:700;color:var(--page);background:var(--grey)}\
.verdict .head{font-size:18px;font-weight:600;margin:0 0 6px}.verdict dl{margin:0;display:grid;grid-template-columns:auto 1fr;gap:2px 12px}\
.verdict dt{color:var(--soft)}.verdict dd{margin:0}\
.good{border-color:var(--green)}.good .sign{background:var(--green)}.watch{border-color:var(--blue)}.watch .sign{background:var(--blue)}\
.plan{border-color:var(--amber)}.plan .sign{background:var(--amber)}.act{border-color:var(--red)}.act .sign{background:var(--red)}\
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(204px,1fr));gap:10px}.tile{background:var(--card);border-radius:6px;padding:10px 14px}\
.tile .name{color:var(--soft);font-size:13px}.tile .value{font-size:19px;font-weight:600;overflow-wrap:anywhere}.tile .note{color:var(--soft);font-size:12.5px;line-height:1.35}\
.none{background:var(--card);border-radius:6px;padding:12px 14px;color:var(--soft)}\
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:13.5px;width:100%}th,td{text-align:left;padding:4px 12px 4px 0;border-bottom:1px solid var(--rule);vertical-align:top}\
th{color:var(--soft);font-weight:600}td.n{font-variant-numeric:tabular-nums;white-space:nowrap}td.n:last-child{white-space:normal;min-width:220px}\
pre{overflow-x:auto;background:var(--card);padding:12px;border-radius:6px;font-size:12.5px;line-height:1.4}\
.kv td:first-child{color:var(--soft);width:45%}.kv td{overflow-wrap:anywhere}summary{cursor:pointer;margin:8px 0}\
@media screen and (max-width:640px){main{padding:16px 14px}.wide{display:none}.narrow{display:block}.verdict{grid-template-columns:1fr}\
.verdict .sign{width:40px;height:40px;font-size:20px}.tiles{grid-template-columns:1fr 1fr}.tile .value{font-size:16px}\
.log thead{display:none}.log tr{display:block;padding:6px 0;border-bottom:1px solid var(--rule)}\
.log td,.log td.n:last-child{display:inline;white-space:normal;padding:0 8px 0 0;border:0}.log td:last-child{color:var(--soft)}}\
@media print{@page{margin:14mm}body{font-size:11pt;background:#fff}main{max-width:none;padding:0}nav{display:none}figure,.tile,.verdict,tr,p{break-inside:avoid}\
h2,h2+p{break-after:avoid}.scroll{overflow:visible}pre{white-space:pre-wrap}*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}";

/// The page as text.
pub fn page(data: &Data, setting: &PageContext<'_>) -> String {
    let outlook = forecast::outlook(data, setting);
    let summary = summary::of(data, setting, &outlook);
    let pictures = pictures::all(data, setting);
    let mut out = head(data, setting);
    verdict(&mut out, &summary);
    for part in &SECTIONS {
        self::part(&mut out, part, data, &pictures);
        match part.id {
            "capacity" => about_forecast(&mut out, data, &outlook),
            "temperature" => alarms(&mut out, data, &pictures),
            "estimator" => estimator(&mut out, data),
            _ => {}
        }
    }
    end(&mut out, data, setting);
    out
}

fn head(data: &Data, setting: &PageContext<'_>) -> String {
    let title = escape(&setting.title);
    let span = data.ends_s().map_or("there is no record".to_owned(), |(first_s, last_s)| {
        let days = (last_s - first_s) / 86_400.0;
        let long = if days >= 2.0 { format!("{days:.0} days") } else { format!("{:.1} h", 24.0 * days) };
        if data.is_dated() {
            format!("{} to {} ({long})", summary::moment(data, first_s), summary::moment(data, last_s))
        } else {
            long
        }
    });
    let cells = match data.cells() {
        0 => "cells unknown".to_owned(),
        1 => "one cell".to_owned(),
        cells => format!("{cells} cells"),
    };
    let links = SECTIONS.iter().map(|part| (part.id, part.title)).chain([("alarms", "Alarms"), ("origin", "Origin")]);
    let links: String = links.map(|(id, title)| format!("<a href=\"#{id}\">{title}</a>")).collect();
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\
         <link rel=\"icon\" href=\"data:,\"><title>{title}</title><style>{}{STYLE}</style></head>\n<body><main>\
         <h1>{title}</h1><p class=\"soft\">Battery report, {cells}, {span}</p><nav>{links}</nav>\n",
        variables()
    )
}

fn verdict(out: &mut String, summary: &summary::Summary) {
    let (class, sign) = (summary.verdict.class(), summary.verdict.sign());
    let line = |name: &str, text: &str| format!("<dt>{name}</dt><dd>{}</dd>", escape(text));
    out.push_str(&format!(
        "<section class=\"verdict {class}\" aria-label=\"Summary\"><div class=\"sign\" aria-hidden=\"true\">{sign}</div>\
         <div><p class=\"head\">{}</p><dl>{}{}</dl></div></section>\n<div class=\"tiles\">",
        escape(&summary.how),
        line("Since when", &summary.since),
        line("What to do", &summary.what),
    ));
    for tile in &summary.tiles {
        let (value, note) = (escape(&tile.value), escape(&tile.note));
        out.push_str(&format!(
            "<div class=\"tile\"><div class=\"name\">{}</div><div class=\"value\">{value}</div><div class=\"note\">{note}</div></div>",
            tile.name
        ));
    }
    out.push_str("</div>\n");
}

fn begin(out: &mut String, id: &str, title: &str, note: &str) {
    out.push_str(&format!("<section><h2 id=\"{id}\">{title}</h2>"));
    if !note.is_empty() {
        out.push_str(&format!("<p class=\"soft\">{note}</p>"));
    }
    out.push('\n');
}

fn figure(out: &mut String, picture: &Picture) {
    out.push_str("<figure>");
    out.push_str(&picture.inline(Size::WIDE, "wide"));
    out.push_str(&picture.inline(Size::NARROW, "narrow"));
    out.push_str("</figure>\n");
}

fn part(out: &mut String, part: &Section, data: &Data, pictures: &[(String, Picture)]) {
    begin(out, part.id, part.title, part.note);
    let own = || part.pictures.iter().filter_map(|name| pictures.iter().find(|(known, _)| known == name));
    if own().count() == 0 {
        out.push_str(&format!("<p class=\"none\">{}</p>", (part.none)(data)));
    }
    own().for_each(|(_, picture)| figure(out, picture));
    out.push_str("</section>\n");
}

/// Why the fan does not begin where the estimate ends, where it does not.
fn gap(data: &Data, outlook: &forecast::Outlook) -> &'static str {
    let last = data.learned.iter().rev().find(|row| row.cell == outlook.cell);
    match (last, outlook.fan.first()) {
        (Some(last), Some(first)) if (first.median_ah - last.capacity_ah.0).abs() > 2.0 * last.capacity_ah.1 => {
            " It begins at what the latest half-cycles say by themselves; the learned capacity is still on its way there."
        }
        _ => "",
    }
}

/// What the forecast in the capacity chart is, or why there is none.
fn about_forecast(out: &mut String, data: &Data, outlook: &Result<forecast::Outlook, String>) {
    let why = match outlook {
        // The part's own words say it already.
        _ if data.learned.is_empty() => return,
        Err(why) => format!("No forecast of the capacity: {why}."),
        Ok(outlook) if outlook.is_over() => "No forecast of the capacity: the end of life is passed.".to_owned(),
        Ok(outlook) if outlook.fan.is_empty() => {
            "The forecast has no dates: how fast the battery is used up is not known.".to_owned()
        }
        Ok(outlook) => {
            let of_cell = if data.cells() > 1 { format!(" for cell {}", outlook.cell + 1) } else { String::new() };
            let doubt = outlook.unknown.as_ref().map_or_else(String::new, |why| {
                format!(" It is the shortest life that is known; another cell's may end sooner: {why}.")
            });
            format!(
                "The fan is what is to come{of_cell} if the battery is used as of late: in one of two cases the end of \
                 life comes before the dashed line meets it, in nine of ten within the band. No knee that has not shown \
                 itself is in it.{}{doubt}",
                gap(data, outlook)
            )
        }
    };
    let class = if outlook.as_ref().is_ok_and(|outlook| !outlook.fan.is_empty()) { "soft" } else { "none" };
    out.push_str(&format!("<p class=\"{class}\">{}</p>\n", escape(&why)));
}

fn alarms(out: &mut String, data: &Data, pictures: &[(String, Picture)]) {
    begin(out, "alarms", "Alarms", "");
    match pictures.iter().find(|(name, _)| name == "alarms") {
        Some((_, picture)) => figure(out, picture),
        None if data.alarms.is_empty() => {
            out.push_str("<p class=\"none\">no alarm was raised in this record</p>");
        }
        None => {}
    }
    if !data.alarms.is_empty() {
        let rows = data.alarms.iter().rev().map(|row| {
            let cells =
                [&summary::moment(data, row.time_s), &row.rule, &row.severity, &row.change, &summary::words(row)];
            cells.map(|text| escape(text)).to_vec()
        });
        table(out, &["When", "Rule", "Severity", "Change", "What"], rows, data.alarms.len());
    }
    if !data.incidents.is_empty() {
        out.push_str("<h3>What else happened</h3>");
        let rows = data.incidents.iter().rev();
        let rows = rows.map(|(time_s, what)| vec![summary::moment(data, *time_s), escape(what)]);
        table(out, &["When", "What"], rows, data.incidents.len());
    }
    out.push_str("</section>\n");
}

/// A table of the first [`MAX_ROWS`] rows; says how many there are.
fn table(out: &mut String, names: &[&str], rows: impl Iterator<Item = Vec<String>>, count: usize) {
    out.push_str("<div class=\"scroll\"><table class=\"log\"><thead><tr>");
    names.iter().for_each(|name| out.push_str(&format!("<th>{name}</th>")));
    out.push_str("</tr></thead><tbody>");
    for row in rows.take(MAX_ROWS) {
        out.push_str("<tr>");
        row.iter().for_each(|cell| out.push_str(&format!("<td class=\"n\">{cell}</td>")));
        out.push_str("</tr>\n");
    }
    out.push_str("</tbody></table></div>");
    if count > MAX_ROWS {
        out.push_str(&format!("<p class=\"soft\">the latest {MAX_ROWS} of {count}; the others are in the picture</p>"));
    }
}

fn estimator(out: &mut String, data: &Data) {
    let health = data.trace.health();
    let (Some(coverage), Some(nis)) = (health.coverage(), health.mean_nis()) else { return };
    let worst = data.trace.cells.iter().enumerate().filter_map(|(cell, health)| Some((cell, health.coverage()?)));
    let worst = worst.min_by(|a, b| a.1.total_cmp(&b.1));
    let mut rows = vec![
        ("Voltage readings compared".to_owned(), grouped(health.count)),
        ("Within the filter's own 95 % interval".to_owned(), format!("{:.1} %", 100.0 * coverage)),
        ("Mean normalised innovation squared (1 = as expected)".to_owned(), format!("{nis:.2}")),
        ("Beyond the gate: not used".to_owned(), grouped(health.gated)),
    ];
    if let Some((cell, share)) = worst.filter(|_| data.cells() > 1) {
        rows.push(("Least covered cell".to_owned(), format!("cell {}: {:.1} %", cell + 1, 100.0 * share)));
    }
    pairs(out, &rows);
}

/// A count with its thousands apart.
fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let groups: Vec<&[u8]> = digits.as_bytes().rchunks(3).rev().collect();
    groups.iter().map(|group| String::from_utf8_lossy(group)).collect::<Vec<_>>().join("\u{202f}")
}

fn pairs(out: &mut String, rows: &[(String, String)]) {
    out.push_str("<div class=\"scroll\"><table class=\"kv\"><tbody>");
    for (name, value) in rows {
        out.push_str(&format!("<tr><td>{}</td><td>{}</td></tr>\n", escape(name), escape(value)));
    }
    out.push_str("</tbody></table></div>\n");
}

fn end(out: &mut String, data: &Data, setting: &PageContext<'_>) {
    begin(out, "origin", "Where this comes from", "");
    let mut rows = vec![("Program".to_owned(), concat!("packwatch ", env!("CARGO_PKG_VERSION")).to_owned())];
    rows.extend(setting.provenance.iter().cloned());
    if let Some(pack) = data.source.pack {
        rows.push((
            "Pack of this history".to_owned(),
            format!("{pack} (the latest; earlier ones are in packwatch history)"),
        ));
    }
    if let Some(config) = setting.config {
        let model = &config.monitor.model;
        let amount = |name: &str, value: String| (name.to_owned(), value);
        rows.push(amount("Cell model", model.name.clone()));
        rows.push(amount(
            "Capacity of a new cell",
            format!("{} Ah (rated {} Ah)", model.capacity_ah, model.rated_capacity_ah),
        ));
        rows.push(amount("Cells", config.monitor.sample.cells.to_string()));
        for rule in &config.monitor.rules {
            let name = rule.rule.name();
            rows.push(amount(
                &format!("Limit {name} ({})", rule.severity.name()),
                summary::amount(rule.threshold, name),
            ));
        }
    }
    pairs(out, &rows);
    if let Some(text) = &setting.config_text {
        out.push_str(&format!(
            "<details><summary>The configuration as it was read</summary><pre>{}</pre></details>",
            escape(text)
        ));
    }
    out.push_str("</section>\n</main></body></html>\n");
}

#[cfg(test)]
mod tests;
