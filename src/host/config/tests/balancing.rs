//! Tests `[input.balancing]`: the bits that show which cells the BMS discharges to balance the pack.

use super::*;
use crate::can::encode::InputEncoder;
use crate::cell_faults::BalancingConfig;

const BITS: &str = "BO_ 1300 Bleeding: 1 A\n SG_ Bleed1 : 0|1@1+ (1,0) [0|1] \"\" A\n SG_ Bleed2 : 1|1@1+ (1,0) [0|1] \"\" A\n \
                    SG_ Bleed3 : 2|1@1+ (1,0) [0|1] \"\" A\n SG_ Bleed4 : 3|1@1+ (1,0) [0|1] \"\" A\n";

fn read_with(pack: &str) -> Result<Config, Vec<String>> {
    read_texts(pack, CELL, &format!("{DBC}\n{BITS}")).map(|(config, _)| config)
}

/// A configuration whose line 15 is `[input.balancing]`.
fn pack(keys: &str) -> String {
    format!("{PACK}[input.balancing]\n{keys}")
}

#[test]
fn each_cell_has_a_bit_and_share_of_current() {
    let two_strings = pack_with("cells = 4", "cells = 4\nstrings = 2");
    let keys = "[input.balancing]\nsignal = \"Bleeding.Bleed{n}\"\nbleed_a = 0.02\n";
    let monitor = read_with(&format!("{two_strings}{keys}")).unwrap().monitor;
    let bits = BalancingConfig { bleed_a: 0.01, max_age_s: 10.0, is_only_while_sent: false };
    assert_eq!(monitor.balancing, Some(bits));
    let (_, frame) = {
        let mut frames = Vec::new();
        let bits = (0..).map(CellIndex).zip([0.0, 1.0, 0.0, 1.0]);
        let values: Vec<_> = bits.map(|(cell, bit)| (Channel::Balancing(cell), Some(bit))).collect();
        assert_eq!(InputEncoder::new(&monitor.input).encode(&values, &mut frames), 0);
        frames.remove(0)
    };
    assert_eq!(frame.data(), [0b1010]);
    assert_eq!(good(PACK).monitor.balancing, None);
}

#[test]
fn balancing_faults_are_reported() {
    let table = [
        (
            pack("signal = \"Bleeding.Bleed{n}\"\n"),
            "pack.toml:15: input.balancing.bleed_a is missing, must be a number, above 0 and at most 1000000 (A): Current of a balancing resistor while the bit is 1, at the BMS's balancing voltage",
        ),
        (
            pack("signal = \"Bleeding.Bleed{n}\"\nbleed_a = 0\n"),
            "pack.toml:17: input.balancing.bleed_a = 0, must be above 0 and at most 1000000",
        ),
        (
            pack("signal = \"Bleeding.Bleed{n}\"\nbleed_a = 0.5\n"),
            "pack.toml:17: input.balancing.bleed_a = 0.5, must be at most 0.4 A (C/5 of the pack's rated capacity)",
        ),
        (
            pack("signal = \"Bleeding.Bleed1\"\nbleed_a = 0.1\n"),
            "pack.toml:16: input.balancing.signal = \"Bleeding.Bleed1\", must contain {n} for the cell's number, because pack.cells = 4",
        ),
        (
            pack("signal = \"Bleeding.Bleed{n}\"\nfirst = 2\nbleed_a = 0.1\n"),
            "pack.toml:16: input.balancing.signal = \"Bleeding.Bleed{n}\", must match a signal for each of 4 cells (pack.cells), but none has number 5",
        ),
        (
            pack("signal = \"Bleeding.Bleed{n}\"\nbleed_a = 0.1\n").replacen(
                "cells = 4",
                "cells = 4\nbalancing = false",
                1,
            ),
            "pack.toml:3: pack.balancing = false, must be true if [input.balancing] is given",
        ),
        (
            pack("signal = \"Bleeding.Bleed{n}\"\nbleed_a = 0.1\n").replacen(
                "[input.cell_voltage]\nsignal = \"Cells.CellVoltage{n}\"",
                "[input.pack_voltage]\nsignal = \"Cells.CellVoltage1\"\nscale = 4.0",
                1,
            ),
            "pack.toml:16: input.balancing must not be given together with [input.pack_voltage]: the pack is then estimated as one cell",
        ),
    ];
    for (pack, fault) in table {
        let found = read_with(&pack).unwrap_err();
        assert!(found.iter().any(|text| text == fault), "{fault}\n{found:#?}");
    }
}
