//! Lists the faults that `packwatch doctor` must find, one per row.

use packwatch::wiring::Topic;

use super::bench::Bench::{self, Charge, Day, Pack12, Pack96, Protected, Pulses, Steady, Total, Walk};
use super::bench::BrokenPack;

/// A fault that is put into a pack.
pub(crate) struct Fault {
    pub(crate) name: &'static str,
    pub(crate) breaks: fn(&mut BrokenPack),
    /// One of these topics must be the first finding.
    pub(crate) expected: &'static [Topic],
    /// Text that the proposed lines must contain; empty = no proposal required.
    pub(crate) proposed: &'static str,
    pub(crate) benches: &'static [Bench],
    pub(crate) seeds: u64,
}

pub(crate) const fn fault(
    name: &'static str,
    breaks: fn(&mut BrokenPack),
    expected: &'static [Topic],
    proposed: &'static str,
    benches: &'static [Bench],
    seeds: u64,
) -> Fault {
    Fault { name, breaks, expected, proposed, benches, seeds }
}

fn invert(broken: &mut BrokenPack) {
    if broken.config.contains("positive = \"charge\"") {
        broken.config("positive = \"charge\"", "positive = \"discharge\"");
    } else {
        broken.config("positive = \"discharge\"", "positive = \"charge\"");
    }
}

fn voltage_table(broken: &BrokenPack) -> &'static str {
    if broken.bench == Total { "[input.pack_voltage]" } else { "[input.cell_voltage]" }
}

fn voltage_scale(broken: &mut BrokenPack, scale: &str) {
    broken.table(voltage_table(broken), &format!("scale = {scale}"));
}

fn temperatures(broken: &mut BrokenPack, keys: &str) {
    broken.table("[[input.temperature]]", keys);
}

fn exchange(broken: &mut BrokenPack, a: &str, b: &str) {
    broken.config(&format!("\"{a}\""), "\"@\"");
    broken.config(&format!("\"{b}\""), &format!("\"{a}\""));
    broken.config("\"@\"", &format!("\"{b}\""));
}

fn without_units(broken: &mut BrokenPack) {
    for unit in ["\"V\"", "\"A\"", "\"degC\""] {
        broken.dbc = broken.dbc.replace(unit, "\"\"");
    }
}

/// Replaces the cell model by the example's model, with `change` applied to every number of the given tables.
fn other_cell(broken: &mut BrokenPack, tables: &[&str], change: impl Fn(f64) -> f64) {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("config/cells");
    let mut model: toml::Table =
        std::fs::read_to_string(folder.join("example_nmc_2600.toml")).unwrap().parse().unwrap();
    change_tables(&mut model, tables, &change);
    broken.extra.push(("cells/other.toml", model.to_string()));
    for shipped in ["cells/example_nmc_2600.toml", "cells/nasa_b0005.toml"] {
        broken.config = broken.config.replace(shipped, "cells/other.toml");
    }
}

fn change_tables(within: &mut toml::Table, tables: &[&str], change: &impl Fn(f64) -> f64) {
    for (key, value) in within {
        if tables.contains(&key.as_str()) {
            change_numbers(value, change);
            continue;
        }
        match value {
            toml::Value::Table(table) => change_tables(table, tables, change),
            toml::Value::Array(items) => {
                items.iter_mut().filter_map(toml::Value::as_table_mut).for_each(|t| change_tables(t, tables, change));
            }
            _ => {}
        }
    }
}

fn change_numbers(value: &mut toml::Value, change: &impl Fn(f64) -> f64) {
    match value {
        toml::Value::Float(number) => *number = change(*number),
        toml::Value::Array(items) => items.iter_mut().for_each(|item| change_numbers(item, change)),
        _ => {}
    }
}

/// All faults; the doctor's first finding must be the expected one.
pub(crate) const FAULTS: &[Fault] = &[
    fault(
        "inverted sign",
        invert,
        &[Topic::CurrentSign],
        "positive = ",
        &[Pack12, Total, Pulses, Steady, Charge, Walk],
        3,
    ),
    fault("inverted sign, many cells", invert, &[Topic::CurrentSign], "positive = \"charge\"", &[Pack96, Day], 1),
    fault(
        "mV for V",
        |b| voltage_scale(b, "1000.0"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total, Pulses, Steady],
        2,
    ),
    fault(
        "V taken for mV",
        |b| voltage_scale(b, "0.001"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total, Pulses, Charge],
        2,
    ),
    fault("0.1 V for V", |b| voltage_scale(b, "10.0"), &[Topic::Unit], "scale = 1.0", &[Pack12, Total, Walk], 2),
    fault(
        "mA for A",
        |b| b.table("[input.current]", "scale = 1000.0"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total, Pulses, Steady, Charge],
        2,
    ),
    fault(
        "A taken for mA",
        |b| b.table("[input.current]", "scale = 0.001"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total, Walk],
        2,
    ),
    fault(
        "0.1 A for A",
        |b| b.table("[input.current]", "scale = 10.0"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total],
        3,
    ),
    fault(
        "A taken for 0.1 A",
        |b| b.table("[input.current]", "scale = 0.1"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total],
        3,
    ),
    fault(
        "kelvin",
        |b| temperatures(b, "offset = 273.15"),
        &[Topic::Unit],
        "offset = 0.0",
        &[Pack12, Total, Steady],
        2,
    ),
    fault(
        "Fahrenheit",
        |b| temperatures(b, "scale = 1.8\noffset = 32.0"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Steady],
        2,
    ),
    fault(
        // The pack is at about 10 degrees C. The same temperature in Fahrenheit is the number 50, which also looks
        // plausible in degrees C.
        "Fahrenheit in the DBC, not converted",
        |b| b.dbc("(0.1,0) [-40|125] \"degC\"", "(0.18,5) [-40|300] \"degF\""),
        &[Topic::Unit],
        "scale = 0.5555",
        &[Pack12, Total],
        2,
    ),
    fault(
        "tenths of a degree",
        |b| temperatures(b, "scale = 10.0"),
        &[Topic::Unit],
        "scale = 1.0",
        &[Pack12, Total, Walk],
        2,
    ),
    fault("offset of 40 degrees", |b| temperatures(b, "offset = 45.0"), &[Topic::Unit], "offset", &[Pack12, Total], 2),
    fault(
        "current under another id",
        |b| b.dbc("BO_ 256 PackStatus", "BO_ 257 PackStatus"),
        &[Topic::Silent],
        "signal",
        &[Pack12, Total, Pack96],
        1,
    ),
    fault(
        "temperatures under another id",
        |b| b.dbc("BO_ 288 Temp", "BO_ 289 Temp"),
        &[Topic::Silent],
        "signal",
        &[Pack12, Total],
        2,
    ),
    fault(
        "29-bit ids in the DBC",
        |b| b.dbc("BO_ 256 ", "BO_ 2147483904 "),
        &[Topic::IdKind],
        "",
        &[Pack12, Total, Pulses, Steady],
        2,
    ),
    fault(
        "the pack is on another bus",
        |b| b.frames(|t, _, id, data| Some(format!("{t} can7 {id}#{data}"))),
        &[Topic::Interface],
        "name = \"can7\"",
        &[Pack12, Total, Steady, Walk],
        2,
    ),
    fault(
        "one message is on another bus",
        |b| b.frames(|t, i, id, data| Some(format!("{t} {} {id}#{data}", if id == "120" { "can3" } else { i }))),
        &[Topic::Interface],
        "interface = \"can3\"",
        &[Pack12, Total],
        2,
    ),
    fault(
        "only error frames",
        |b| b.frames(|t, i, _, _| Some(format!("{t} {i} 20000008#0000040000000000"))),
        &[Topic::BitRate],
        "",
        &[Steady, Pulses],
        2,
    ),
    fault(
        "a silent bus and a busy one",
        |b| b.frames(|t, _, _, data| Some(format!("{t} can5 7FF#{data}"))),
        &[Topic::Interface],
        "name",
        &[Steady, Walk],
        2,
    ),
    fault(
        "FD frames",
        |b| b.frames(|t, i, id, data| Some(format!("{t} {i} {id}##1{data}"))),
        &[Topic::Fd],
        "fd = true",
        &[Pack12, Steady, Pulses],
        2,
    ),
    fault(
        "byte order of the cells",
        |b| {
            b.dbc("16|16@1+ (0.0001", "23|16@0+ (0.0001");
            b.dbc("32|16@1+ (0.0001", "39|16@0+ (0.0001");
            b.dbc("48|16@1+ (0.0001", "55|16@0+ (0.0001")
        },
        &[Topic::Layout],
        "",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "byte order of the current",
        |b| b.dbc("0|16@1- (0.1", "7|16@0- (0.1"),
        &[Topic::Layout],
        "",
        &[Pack12, Total],
        3,
    ),
    fault("unsigned current", |b| b.dbc("0|16@1- (0.1", "0|16@1+ (0.1"), &[Topic::Layout], "", &[Pack12, Total], 3),
    fault(
        "byte order of the pack voltage",
        |b| b.dbc("16|16@1+ (0.1", "23|16@0+ (0.1"),
        &[Topic::Layout, Topic::Unit, Topic::CellCount],
        "",
        &[Total],
        3,
    ),
    fault(
        "fewer cells than configured, no page",
        |b| {
            b.data("110", |d| {
                if d[0] > 2 {
                    d[0] = 60
                }
            })
        },
        &[Topic::CellCount],
        "cells = 9",
        &[Pack12],
        4,
    ),
    fault(
        "fewer cells than configured, zeros",
        |b| {
            b.data("110", |d| {
                if d[0] > 2 {
                    d[2..].fill(0)
                }
            })
        },
        &[Topic::CellCount],
        "cells = 9",
        &[Pack12],
        4,
    ),
    fault(
        // The pack may be smaller than configured, or a module may be dead.
        "last cells without values",
        |b| {
            b.data("110", |d| {
                if d[0] > 2 {
                    d[2..].fill(0xFF)
                }
            })
        },
        &[Topic::Silent],
        "signal",
        &[Pack12],
        4,
    ),
    fault(
        "more cells than configured",
        |b| {
            b.config("cells = 12 ", "cells = 10 ");
            b.config("cells = \"9-12\"", "cells = \"9-10\"")
        },
        &[Topic::CellCount],
        "cells = 12",
        &[Pack12],
        4,
    ),
    fault(
        "more cells than configured, many",
        |b| {
            b.config("cells = 96 ", "cells = 92 ");
            b.config("cells = \"89-96\"", "cells = \"89-92\"")
        },
        &[Topic::CellCount],
        "cells = 96",
        &[Pack96],
        1,
    ),
    fault(
        "wrong number of cells in the total voltage",
        |b| b.config("cells = 96 ", "cells = 60 "),
        &[Topic::CellCount],
        "cells",
        &[Total],
        4,
    ),
    fault(
        "one page missing",
        |b| {
            b.data("110", |d| {
                if d[0] == 1 {
                    d[0] = 60
                }
            })
        },
        &[Topic::Silent],
        "signal",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "current not available",
        |b| b.data("100", |d| d[3..6].copy_from_slice(&[0, 0, 0x80])),
        &[Topic::Silent],
        "signal",
        &[Steady, Pulses, Walk],
        2,
    ),
    fault("short frames", |b| b.data("110", |d| d.truncate(4)), &[Topic::Silent], "", &[Pack12], 2),
    fault(
        "total voltage read as current",
        |b| exchange(b, "PackStatus.Current", "PackStatus.PackVoltage"),
        &[Topic::Swapped],
        "signal",
        &[Total],
        3,
    ),
    fault(
        "total voltage and current swapped, no units",
        |b| {
            exchange(b, "PackStatus.Current", "PackStatus.PackVoltage");
            without_units(b)
        },
        &[Topic::Swapped],
        "signal",
        &[Total],
        3,
    ),
    fault(
        "current from the pack voltage",
        |b| b.config("PackStatus.Current", "PackStatus.PackVoltage"),
        &[Topic::Swapped],
        "signal",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "voltage and temperature swapped",
        |b| exchange(b, "MeasuredCell.Voltage", "MeasuredCell.Temperature"),
        &[Topic::Swapped],
        "signal",
        &[Pulses, Steady, Walk],
        2,
    ),
    fault(
        "voltage and temperature swapped, no units",
        |b| {
            exchange(b, "MeasuredCell.Voltage", "MeasuredCell.Temperature");
            without_units(b)
        },
        &[Topic::Swapped],
        "signal",
        &[Pulses, Steady, Charge],
        2,
    ),
    fault(
        "voltage and current swapped",
        |b| exchange(b, "MeasuredCell.Voltage", "MeasuredCell.Current"),
        &[Topic::Swapped],
        "signal",
        &[Pulses, Steady, Walk],
        2,
    ),
    fault(
        "voltage and current swapped, no units",
        |b| {
            exchange(b, "MeasuredCell.Voltage", "MeasuredCell.Current");
            without_units(b)
        },
        &[Topic::Swapped],
        "signal",
        &[Pulses, Steady, Charge],
        2,
    ),
    fault(
        "temperature and current swapped, no units",
        |b| {
            exchange(b, "MeasuredCell.Temperature", "MeasuredCell.Current");
            without_units(b)
        },
        &[Topic::Swapped],
        "signal",
        &[Walk],
        3,
    ),
    fault(
        "a cell's voltage is frozen",
        |b| {
            b.data("110", |d| {
                if d[0] == 1 {
                    d[2..4].copy_from_slice(&38_000_u16.to_le_bytes())
                }
            })
        },
        &[Topic::Frozen],
        "signal",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "the current is frozen",
        |b| b.data("100", |d| d[..2].copy_from_slice(&[20, 0])),
        &[Topic::Frozen],
        "signal",
        &[Pack12, Total],
        2,
    ),
    fault(
        "a cell that differs from the others",
        |b| {
            b.data("110", |d| {
                if d[0] == 1 {
                    let v = 25_000 + u16::from(d[2]);
                    d[2..4].copy_from_slice(&v.to_le_bytes())
                }
            })
        },
        &[Topic::Cell],
        "signal",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "a cell with reversed sign",
        |b| {
            b.data("110", |d| {
                if d[0] == 1 {
                    let v = 78_000 - u32::from(u16::from_le_bytes([d[2], d[3]]));
                    d[2..4].copy_from_slice(&(v as u16).to_le_bytes())
                }
            })
        },
        &[Topic::Cell],
        "",
        &[Pack12],
        3,
    ),
    fault(
        "stale before the next reading",
        |b| b.config("max_age_s = 0.5", "max_age_s = 0.004"),
        &[Topic::Period],
        "max_age_s",
        &[Pack12, Total],
        2,
    ),
    fault(
        "voltages stale before the next reading",
        |b| b.config("max_age_s = 2.0", "max_age_s = 0.05"),
        &[Topic::Period],
        "max_age_s",
        &[Pack12, Total],
        2,
    ),
    fault(
        "stale after one lost frame",
        |b| b.config("max_age_s = 2.0", "max_age_s = 0.15"),
        &[Topic::Period],
        "max_age_s",
        &[Pack12, Total],
        2,
    ),
    fault(
        "nine frames of ten lost",
        |b| {
            let mut n = 0;
            b.frames(move |t, i, id, data| {
                n += 1;
                (n % 10 == 0 || id != "100").then(|| format!("{t} {i} {id}#{data}"))
            })
        },
        &[Topic::Period],
        "",
        &[Pack12, Total],
        2,
    ),
    fault(
        "limits too tight",
        |b| b.config("max_discharge_a = 30.0", "max_discharge_a = 0.2"),
        &[Topic::Range],
        "max_discharge_a",
        &[Pack12, Total],
        2,
    ),
    fault(
        "cell model of iron phosphate",
        |b| other_cell(b, &["ocv_v", "voltage_min_v", "voltage_max_v"], |v| 0.85 * v),
        &[Topic::CellModel],
        "cell_model",
        &[Pack12, Pack96, Steady],
        2,
    ),
    fault(
        "cell model of a much larger cell",
        |b| other_cell(b, &["r0_ohm", "r_ohm"], |ohm| 0.25 * ohm),
        &[Topic::CellModel, Topic::Unit],
        "",
        &[Pack12, Total],
        2,
    ),
    fault(
        "wrong data id",
        |b| b.config("data_id = 0x123", "data_id = 0x321"),
        &[Topic::Protection],
        "data_id",
        &[Protected],
        3,
    ),
    fault("damaged checksums", |b| b.data("100", |d| d[0] ^= 0x5A), &[Topic::Protection], "", &[Protected], 3),
    fault(
        "repeated counters",
        |b| b.log = b.log.lines().flat_map(|line| [line, line]).collect::<Vec<_>>().join("\n"),
        &[Topic::Protection],
        "",
        &[Protected],
        3,
    ),
    fault(
        "another node sends our frames",
        |b| {
            b.log.push_str(
                "(1700000060.000000) can0 6B0#0011223344556677\n(1700000060.100000) can0 6B0#0011223344556677\n",
            )
        },
        &[Topic::Conflict],
        "id",
        &[Pack12, Total, Pack96],
        2,
    ),
    fault(
        "twice the strings",
        |b| b.config("strings = 1\n", "strings = 8\n"),
        &[Topic::Unit, Topic::CellModel],
        "",
        &[Pack12, Total],
        2,
    ),
];
