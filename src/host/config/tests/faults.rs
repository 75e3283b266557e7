//! Tests one wrong key at a time, and compares the full text of its fault.

use super::*;

/// Applies each edit (from, to) to `PACK` and compares the one resulting fault.
fn each_edit_gives(table: &[(&str, &str, &str)]) {
    for (from, to, fault) in table {
        assert_eq!(faults(&pack_with(from, to)), [*fault], "{from} -> {to}");
    }
}

/// If the work grew with the square of the number of tables, this test would take minutes.
#[test]
fn many_tables_are_checked_in_seconds() {
    let begun = std::time::Instant::now();
    let diagnostic = |n: u32| {
        format!(
            "[[input.diagnostic]]\nname = \"D{n}\"\nrequest = 0x7E4\nresponse = 0x7EC\nservice = 0x22\nidentifier = {n}\n\
             signals = [{{ name = \"S{n}\", bit = 0, length = 8, unit = \"V\" }}]\n"
        )
    };
    let protected = |n: u32| format!("[[input.protected]]\nmessage = \"M{n}\"\nprofile = \"1A\"\ndata_id = 1\n");
    let unknown = |n: u32| format!("[junk{n}]\nx = 1\n");
    let makers: [&dyn Fn(u32) -> String; 3] = [&diagnostic, &protected, &unknown];
    for make in makers {
        let tables: String = (1..=10_000).map(make).collect();
        let found = read_texts(&format!("{PACK}{tables}"), CELL, DBC).map_or_else(|faults| faults.len(), |_| 0);
        let elapsed_s = begun.elapsed().as_secs_f64();
        assert!(elapsed_s < 60.0, "{found} faults after {elapsed_s} s");
    }
}

#[test]
fn faults_state_file_line_key_found_and_allowed() {
    let table: &[(&str, &str, &str)] = &[
        ("cells = 4", "cells = 0", "pack.toml:2: pack.cells = 0, must be 1 to 1024"),
        ("cells = 4", "cells = -1", "pack.toml:2: pack.cells = -1, must be 1 to 1024"),
        (
            "cells = 4",
            "cells = 99999999999999999999",
            "pack.toml:2: pack.cells = 99999999999999999999, must be 1 to 1024",
        ),
        ("cells = 4", "cells = 4.0", "pack.toml:2: pack.cells = 4.0, must be a whole number, 1 to 1024"),
        ("cells = 4", "cells = \"four\"", "pack.toml:2: pack.cells = \"four\", must be a whole number, 1 to 1024"),
        (
            "cells = 4\n",
            "",
            "pack.toml:1: pack.cells is missing, must be a whole number, 1 to 1024: Number of cells in series",
        ),
        ("cells = 4", "cells = 4\nstring = 1", "pack.toml:3: pack.string is not a known key, did you mean strings"),
        ("cells = 4", "cells = 4\nambient_c = nan", "pack.toml:3: pack.ambient_c = nan, must be -100 to 200"),
        ("cells = 4", "cells = 4\nambient_c = inf", "pack.toml:3: pack.ambient_c = inf, must be -100 to 200"),
        // The estimator's shortest time step is 1 ms.
        (
            "[input]",
            "[estimator]\nmax_information_s = 0.0005\n[input]",
            "pack.toml:7: estimator.max_information_s = 0.0005, must be 0.001 to 1000000",
        ),
        ("cells = 4", "cells = 4\ncells = 5", "pack.toml:3: invalid TOML: the key cells is set twice, first in line 2"),
        (
            "cells = 4",
            "cells = 4\nrated_capacity_ah = 0",
            "pack.toml:3: pack.rated_capacity_ah = 0, must be 0.001 to 100000",
        ),
        ("[[interface]]", "[interface]", "pack.toml:4: interface = [interface], must be tables [[interface]]"),
        ("[input]", "[[input]]", "pack.toml:6: input = [[input]], must be one table [input]"),
        (
            "\"can0\"",
            "\"a name too long to be one\"",
            "pack.toml:5: interface[1].name = \"a name too long to be one\", must be at most 15 characters without spaces or /",
        ),
        (
            "dbc = [\"pack.dbc\"]",
            "dbc = []",
            "pack.toml:7: input.dbc = [], must be a list of DBC files if there is no [[input.diagnostic]]",
        ),
        ("dbc = [\"pack.dbc\"]", "dbc = [\"pack.dbc\", 7]", "pack.toml:7: input.dbc = 7, must be a list of strings"),
    ];
    each_edit_gives(table);
}

#[test]
fn signal_faults_state_contents_of_dbc() {
    let table: &[(&str, &str, &str)] = &[
        (
            "positive = \"charge\"\n",
            "",
            "pack.toml:8: input.current.positive is missing, must be charge or discharge: Meaning of a positive value on the bus",
        ),
        ("\"charge\"", "\"in\"", "pack.toml:10: input.current.positive = \"in\", must be charge or discharge"),
        (
            "\"charge\"",
            "\"charge\"\ninterface = \"can1\"",
            "pack.toml:11: input.current.interface = \"can1\", must be can0",
        ),
        (
            "\"charge\"",
            "\"charge\"\nscale = 0",
            "pack.toml:11: input.current.scale = 0, must be above 0 and at most 1000000000",
        ),
        (
            "\"charge\"",
            "\"charge\"\nnot_available = [0x1_0000]",
            "pack.toml:11: input.current.not_available = [0x1_0000], must be 0 to 0xFFFF, the codes of Status.Current",
        ),
        (
            "Status.Current",
            "Status.Curent",
            "pack.toml:9: input.current.signal = \"Status.Curent\", must be a signal (Message.Signal) of pack.dbc, did you mean Status.Current",
        ),
        (
            "Status.Current",
            "Long.Current",
            "pack.toml:9: input.current.signal = \"Long.Current\", message Long has 12 bytes, requires fd = true on its interface",
        ),
        (
            "Status.Temperature\"",
            "Status.Current\"\nscale = 1.0",
            "pack.toml:14: input.temperature[1].signal = \"Status.Current\", must not be used twice, but is also pack current",
        ),
        (
            "CellVoltage{n}",
            "CellVoltage1",
            "pack.toml:12: input.cell_voltage.signal = \"Cells.CellVoltage1\", must contain {n} for the cell's number, because pack.cells = 4",
        ),
        (
            "CellVoltage{n}",
            "CellVoltage{x}",
            "pack.toml:12: input.cell_voltage.signal = \"Cells.CellVoltage{x}\", must use braces only for {n} (the cell's number) and {m} (any number)",
        ),
        (
            "CellVoltage{n}",
            "CellVoltage{n}\"\nfirst = 3\ninterface = \"can0",
            "pack.toml:12: input.cell_voltage.signal = \"Cells.CellVoltage{n}\", must match a signal for each of 4 cells (pack.cells), but none has number 5, 6",
        ),
        (
            "[input.cell_voltage]\nsignal = \"Cells.CellVoltage{n}\"\n",
            "",
            "pack.toml:6: input has no voltage, must have [input.cell_voltage] or [input.pack_voltage]",
        ),
        (
            "Status.Temperature\"",
            "Status.Temperature\"\ncells = \"3-5\"",
            "pack.toml:15: input.temperature[1].cells = \"3-5\", must be within 1 to 4 (pack.cells)",
        ),
        (
            "Status.Temperature\"",
            "Status.Temperature\"\ncells = \"4-3\"",
            "pack.toml:15: input.temperature[1].cells = \"4-3\", must be cell numbers from 1, ranges ascending, like \"1-12, 15\"",
        ),
    ];
    each_edit_gives(table);
}

#[test]
fn faults_of_repeatable_tables_are_reported() {
    let table: &[(&str, &str)] = &[
        ("[pak]\n", "pack.toml:15: pak is not a known key, did you mean pack"),
        ("[recharge]\nto_soc = 0.3\n", "pack.toml:16: recharge.to_soc = 0.3, must be above recharge.from_soc = 0.3"),
        (
            "[recharge]\nfrom_soc = 0.95\n",
            "pack.toml:16: recharge.from_soc = 0.95, must be below recharge.to_soc = 0.9",
        ),
        (
            "[limits.voltage]\nmin_v = 4\nmax_v = 3\n",
            "pack.toml:17: limits.voltage.max_v = 3, must be above 4, the lower limit",
        ),
        (
            "[limits.amps]\n",
            "pack.toml:15: limits.amps is not a known key, must be one of current, temperature, voltage",
        ),
        (
            "[usable]\ncurrent_a = 2\ntemperature_c = 24\ncutoff_v = 4.2\n",
            "pack.toml:18: usable.cutoff_v = 4.2, must be below the cell model's voltage_max_v = 4.2",
        ),
        (
            "[output.status]\nid = 0x800\n",
            "pack.toml:16: output.status.id = 0x800, must be 0 to 0x7FF; a longer identifier requires extended = true",
        ),
        (
            "[output.status]\nid = 1\n[output.alarm]\nid = 1\n",
            "pack.toml:18: output.alarm.id = 1, must differ: the alarm and status frames would both have identifier 001",
        ),
        (
            "[output]\n[output.alarm]\nid = 0x6B0\n",
            "pack.toml:17: output.alarm.id = 0x6B0, must differ: the alarm and status frames would both have identifier 6B0",
        ),
        ("[output.alarm]\nextended = true\n", "pack.toml:16: output.alarm.extended = true, requires the key id"),
        ("[output.alarm]\nperiod_ms = 9\n", "pack.toml:16: output.alarm.period_ms = 9, must be 10 to 3600000"),
        ("[output.alarm]\ne2e = \"2\"\n", "pack.toml:16: output.alarm.e2e = \"2\", must be one of off, 1A, 1C, 5"),
        (
            "[output.alarm]\ne2e = \"1A\"\n",
            "pack.toml:15: output.alarm.data_id is not set, must be 0 to 0xFFFF with e2e = \"1A\"",
        ),
        ("[output.alarm]\ndata_id = 1\n", "pack.toml:16: output.alarm.data_id = 1, requires e2e or secoc"),
        (
            "[output.alarm]\ne2e = \"1C\"\ndata_id = 0x1000\n",
            "pack.toml:17: output.alarm.data_id = 0x1000, must be 0 to 0xFFF with profile 1C",
        ),
        (
            "[output.status]\ne2e = \"1C\"\ndata_id = 7\n[output.alarm]\ne2e = \"1A\"\ndata_id = 7\n",
            "pack.toml:20: output.alarm.data_id = 7, must differ: the alarm and status frames would both have data id 0x7",
        ),
        (
            "[output.health]\ne2e = \"5\"\ndata_id = 7\n",
            "pack.toml:16: output.health.e2e = \"5\", must have fd = true here and on the interface: the header of \
             profile 5 makes the message 12 bytes long; 1A and 1C fit classic frames",
        ),
        ("[output.health]\nfd = true\n", "pack.toml:16: output.health.fd = true, requires fd = true on interface can0"),
        (
            "[output.health]\nbrs = true\n",
            "pack.toml:16: output.health.brs = true, must have fd = true: classic frames have one bit rate",
        ),
        ("[output]\nstatus_id = 1\n", "pack.toml:16: output.status_id is not a known key, did you mean status"),
        (
            "[output]\nenabled = true\ninterfaces = [\"can7\"]\n",
            "pack.toml:17: output.interfaces = [\"can7\"], must be can0",
        ),
        (
            "[output.health]\nid = 0x110\n",
            "pack.toml:16: output.health.id = 0x110, must not be the identifier of an input, but Cells has 110",
        ),
        (
            "[[interface]]\nname = \"can0\"\n",
            "pack.toml:16: interface[2].name = \"can0\", must be unique, but is also the name in line 5",
        ),
    ];
    for (text, fault) in table {
        let all = faults(&format!("{PACK}{text}"));
        assert!(all.contains(&(*fault).to_owned()), "{text}: {all:#?}");
        assert!(all.len() == 1 || text.starts_with("[[interface]]"), "{text}: {all:#?}");
    }
}

#[test]
fn missing_dbc_is_reported_at_its_key() {
    let expected = [
        "no.dbc: cannot be read: entity not found",
        "pack.toml:7: input.dbc = [\"no.dbc\"], \"no.dbc\" must be a DBC file, relative to the folder of the configuration",
    ];
    assert_eq!(faults(&pack_with("dbc = [\"pack.dbc\"]", "dbc = [\"no.dbc\"]")), expected);
}
