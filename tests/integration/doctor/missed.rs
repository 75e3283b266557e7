//! Faults that were once called healthy, in rows of the same form.

use packwatch::doctor::Topic;

use super::bench::Bench::{Pack12, Pack96, Pulses, Steady, Total, Walk};
use super::bench::Broken;
use super::faults::{Fault, fault};

/// Leaves the start bits of the cells as they were, which one who exchanges `@1` and `@0` does.
fn byte_order_alone(broken: &mut Broken) {
    for start in [16, 32, 48] {
        broken.dbc(&format!("{start}|16@1+ (0.0001"), &format!("{start}|16@0+ (0.0001"));
    }
}

/// Loses one frame in `of` of an identifier.
fn lose(broken: &mut Broken, wanted: &str, of: u32) {
    let mut n = 0;
    broken.frames(|stamp, interface, id, data| {
        n += u32::from(id == wanted);
        (id != wanted || !n.is_multiple_of(of)).then(|| format!("{stamp} {interface} {id}#{data}"))
    });
}

/// Replaces two bytes of a page's data.
fn set(data: &mut [u8], page: u8, at: usize, value: i32) {
    if data[0] == page {
        data[at..at + 2].copy_from_slice(&i16::try_from(value).unwrap().to_le_bytes());
    }
}

/// As the healthy ones, with what the doctor looks at in addition.
pub(crate) const HEALTHY: &[(&str, fn(&mut Broken))] = &[("one frame in a hundred lost", |b| lose(b, "100", 100))];

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
    fault("one current in seven lost", |b| lose(b, "100", 7), &[Topic::Period], "", &[Pack12, Total, Steady, Walk], 2),
    fault("one page in seven lost", |b| lose(b, "110", 7), &[Topic::Period], "", &[Pack12, Pack96], 2),
    fault("one temperature in seven lost", |b| lose(b, "120", 7), &[Topic::Period], "", &[Pack12], 2),
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
        // Three packs beside each other: a third of the resistance.
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
];
