//! Lists further faults, in the same form as the module `faults`. An earlier version of `packwatch doctor` missed each
//! of them.

use packwatch::wiring::Topic;

use super::bench::Bench::{Pack12, Pack96, Pulses, Steady, Total, Walk};
use super::bench::BrokenPack;
use super::faults::{Fault, fault};

/// Changes the byte order of the cells from `@1` to `@0` but leaves their start bits unchanged.
fn byte_order_alone(broken: &mut BrokenPack) {
    for start in [16, 32, 48] {
        broken.dbc(&format!("{start}|16@1+ (0.0001"), &format!("{start}|16@0+ (0.0001"));
    }
}

/// Drops one of every `of` frames with the identifier `wanted`.
fn lose(broken: &mut BrokenPack, wanted: &str, of: u32) {
    let mut n = 0;
    broken.frames(|stamp, interface, id, data| {
        n += u32::from(id == wanted);
        (id != wanted || !n.is_multiple_of(of)).then(|| format!("{stamp} {interface} {id}#{data}"))
    });
}

/// If the data belong to the multiplexer page `page`, writes `value` to two bytes of the data.
fn set(data: &mut [u8], page: u8, at: usize, value: i32) {
    if data[0] == page {
        data[at..at + 2].copy_from_slice(&i16::try_from(value).unwrap().to_le_bytes());
    }
}

/// Adds a second bus. Another sender on this bus uses identifier 100 to send the first sender's current, inverted and
/// delayed. The configured current is on interface `on`.
fn second_bus(broken: &mut BrokenPack, on: &str) {
    broken.config("[[interface]]\nname = \"can0\"", "[[interface]]\nname = \"can1\"\n\n[[interface]]\nname = \"can0\"");
    broken.table("[input.cell_voltage]", "interface = \"can0\"");
    broken.table("[[input.temperature]]", "interface = \"can0\"");
    broken.table("[input.current]", &format!("interface = \"{on}\""));
    let mut delayed = std::collections::VecDeque::new();
    broken.frames(|stamp, interface, id, data| {
        let line = format!("{stamp} {interface} {id}#{data}");
        if id != "100" {
            return Some(line);
        }
        delayed.push_back(data.to_owned());
        let other = if delayed.len() > 700 { delayed.pop_front()? } else { "1400000000000000".to_owned() };
        Some(format!("{line}\n{stamp} can1 {id}#{other}"))
    });
}

/// Adds a pack voltage signal. Its value is `by` x number of cells x mean voltage of the first cell.
fn pack_voltage(broken: &mut BrokenPack, by: f64) {
    let cells = if broken.bench == Pack96 { 96.0 } else { 12.0 };
    let (mut sum, mut n) = (0.0, 0.0);
    broken.data("110", |data| {
        if data[0] == 0 {
            (sum, n) = (sum + 1e-4 * f64::from(u16::from_le_bytes([data[2], data[3]])), n + 1.0);
        }
    });
    let code = (10.0 * by * cells * sum / n).round() as u16;
    broken.data("100", |data| data[2..4].copy_from_slice(&code.to_le_bytes()));
}

/// Adds two SOC signals: 80 % from the BMS, and `dash` (%) from the dashboard.
pub(crate) fn two_socs(broken: &mut BrokenPack, dash: u8) {
    broken.dbc(
        "CM_ \"Example",
        "BO_ 768 Bms: 8 BMS\n SG_ PackSoc : 0|8@1+ (1,0) [0|100] \"%\" X\n\nBO_ 769 Dash: 8 BMS\n SG_ DisplaySoc : 0|8@1+ (1,0) \
         [0|100] \"%\" X\n\nCM_ \"Example",
    );
    broken.config("[input.cell_voltage]", "[input.reported_soc]\nsignal = \"Bms.PackSoc\"\n\n[input.cell_voltage]");
    let mut n = 0;
    broken.frames(|stamp, interface, id, data| {
        n += u32::from(id == "100");
        let line = format!("{stamp} {interface} {id}#{data}");
        let is_time = id == "100" && n % 50 == 1;
        Some(if is_time {
            format!("{line}\n{stamp} {interface} 300#50\n{stamp} {interface} 301#{dash:02X}")
        } else {
            line
        })
    });
}

/// Name of a healthy pack, and the change that creates it.
type Change = (&'static str, fn(&mut BrokenPack));

/// Further healthy packs, with the additional inputs that the doctor checks.
pub(crate) const HEALTHY: &[Change] = &[
    ("two buses with one identifier", |b| second_bus(b, "can0")),
    ("the pack's voltage is the sum of its cells", |b| pack_voltage(b, 1.005)),
    ("the dashboard agrees", |b| two_socs(b, 82)),
    ("one frame in a hundred lost", |b| lose(b, "100", 100)),
];

pub(crate) const MISSED: &[Fault] = &[
    fault("byte order of the cells, start bits unmoved", byte_order_alone, &[Topic::Layout], "", &[Pack12, Pack96], 2),
    fault(
        "byte order of the current, start bit unmoved",
        |b| b.dbc("0|16@1- (0.1", "0|16@0- (0.1"),
        &[Topic::Layout],
        "",
        &[Pack12, Total],
        2,
    ),
    fault(
        "a sensor of two without a value",
        |b| b.data("120", |d| set(d, 0, 4, 2550)),
        &[Topic::Cell],
        "signal",
        &[Pack12],
        2,
    ),
    fault(
        "all sensors far too hot",
        |b| {
            let mut n = 0;
            b.data("120", |d| {
                n = (n * 7 + 3) % 118;
                let page = d[0];
                [2, 4, 6].into_iter().for_each(|at| set(d, page, at, 10 * (137 + n)))
            })
        },
        &[Topic::Unit, Topic::Range, Topic::Layout],
        "",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "a sensor that jumps to 255",
        |b| {
            let mut n = 0;
            b.data("120", |d| {
                n += 1;
                if n % 3 == 0 {
                    set(d, 0, 2, 2550)
                }
            })
        },
        &[Topic::Unit, Topic::Range, Topic::Cell],
        "",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "one cell, 137 to 255 degrees",
        |b| {
            let mut n = 0;
            b.data("100", |d| {
                n = (n * 7 + 3) % 118;
                let code = i16::try_from(100 * (137 + n)).unwrap();
                d[6..8].copy_from_slice(&code.to_le_bytes())
            })
        },
        &[Topic::Unit, Topic::Range],
        "",
        &[Steady, Pulses],
        2,
    ),
    fault(
        "137 to 255 degrees in one of two sensors, no range in the DBC",
        |b| {
            b.dbc("[-40|125]", "[0|0]");
            let mut n = 0;
            b.data("120", |d| {
                n = (n * 7 + 3) % 118;
                set(d, 0, 2, 10 * (137 + n))
            })
        },
        &[Topic::Cell],
        "signal",
        &[Pack12],
        2,
    ),
    fault(
        "two cells read the same bits",
        |b| b.dbc("CellVoltage5 m1 : 32|16", "CellVoltage5 m1 : 16|16"),
        &[Topic::Swapped],
        "signal",
        &[Pack12, Pack96],
        1,
    ),
    fault(
        "two cells have the same values",
        |b| {
            b.data("110", |d| {
                if d[0] == 1 {
                    d.copy_within(2..4, 6)
                }
            })
        },
        &[Topic::Swapped],
        "signal",
        &[Pack12, Pack96],
        2,
    ),
    fault(
        "one current frame in seven lost",
        |b| lose(b, "100", 7),
        &[Topic::Period],
        "",
        &[Pack12, Total, Steady, Walk],
        2,
    ),
    fault(
        "one current frame in seven lost, uneven sender",
        |b| {
            lose(b, "100", 7);
            let mut n = 0_u32;
            b.frames(|stamp, interface, id, data| {
                n = n.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let late_us = if id == "100" { u64::from(n >> 16) * 3000 / 65536 } else { 0 };
                let (seconds, fraction) = stamp.trim_matches(['(', ')']).split_once('.').unwrap();
                let ns = 1000 * late_us + fraction.parse::<u64>().unwrap();
                let seconds = seconds.parse::<u64>().unwrap() + ns / 1_000_000_000;
                Some(format!("({seconds}.{:09}) {interface} {id}#{data}", ns % 1_000_000_000))
            })
        },
        &[Topic::Period],
        "",
        &[Pack12],
        2,
    ),
    fault("one cell page in seven lost", |b| lose(b, "110", 7), &[Topic::Period], "", &[Pack12, Pack96], 2),
    fault("one temperature frame in seven lost", |b| lose(b, "120", 7), &[Topic::Period], "", &[Pack12], 2),
    fault(
        "three times the strings",
        |b| b.config("strings = 1\n", "strings = 3\n"),
        &[Topic::CellModel],
        "strings = 1",
        &[Pack12, Total],
        3,
    ),
    fault(
        "a third of the strings",
        // Triple the current, as if three packs were connected in parallel.
        |b| {
            b.data("100", |d| {
                let code = i16::from_le_bytes([d[0], d[1]]);
                d[..2].copy_from_slice(&(3 * code).to_le_bytes())
            })
        },
        &[Topic::CellModel],
        "strings = 3",
        &[Pack12, Total],
        3,
    ),
    fault(
        "current of the other bus",
        |b| second_bus(b, "can1"),
        &[Topic::Interface],
        "interface = \"can0\"",
        &[Pack12],
        3,
    ),
    fault(
        "current of the other pack",
        |b| {
            second_bus(b, "can1");
            b.frames(|stamp, interface, id, data| {
                let code = i16::from_le_bytes([0, 2].map(|at| u8::from_str_radix(&data[at..at + 2], 16).unwrap()));
                let half = (code / 2).to_le_bytes();
                match (interface, id) {
                    ("can1", "100") => None,
                    (_, "100") => Some(format!(
                        "{stamp} {interface} {id}#{data}\n{stamp} can1 {id}#{:02X}{:02X}000000000000",
                        half[0], half[1]
                    )),
                    _ => Some(format!("{stamp} {interface} {id}#{data}")),
                }
            })
        },
        &[Topic::Interface],
        "interface = \"can0\"",
        &[Pack12],
        2,
    ),
    fault(
        "the pack's voltage is not the sum of its cells",
        |b| pack_voltage(b, 1.1),
        &[Topic::PackVoltage],
        "",
        &[Pack12, Pack96],
        2,
    ),
    fault("the dashboard shows another SOC", |b| two_socs(b, 60), &[Topic::ReportedSoc], "", &[Pack12], 2),
];
