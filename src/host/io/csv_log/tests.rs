//! Tests the reader of tables on small texts.

use super::*;
use crate::quantity::CellIndex;

fn open(text: &str) -> Result<CsvLog, TableError> {
    let options = CsvOptions { cells: 1, ..CsvOptions::default() };
    CsvLog::open(Box::new(std::io::Cursor::new(text.to_owned())), Path::new("cell.csv"), &options)
}

#[test]
fn battery_data_format_current_changes_sign() {
    let mut log = open("Test Time / s,Voltage / V,Current / A\n0,3.5,-2\n").expect("opens");
    assert!(matches!(log.next_row(), Ok(Some(Ok(_)))));
    let expected = [(Channel::Current, Some(2.0)), (Channel::CellVoltage(CellIndex(0)), Some(3.5))];
    assert!(log.values.len() == 2 && expected.iter().all(|value| log.values.contains(value)), "{:?}", log.values);
}

#[test]
fn reading_states_columns_units_sign_and_share() {
    let mut log = open("Test_Time(s),Step_Index,Cycle_Index,Current(mA),Voltage(V)\n0,1,1,-500,3.5\n1,1,1,x,3.5\n")
        .expect("opens");
    while log.next_row().expect("reads").is_some() {}
    assert_eq!(
        log.reading().to_string(),
        "cell.csv: Arbin; time: column 1 \"Test_Time(s)\" in s; current: column 4 \"Current(mA)\" in mA, charge \
         positive; voltage: column 5 \"Voltage(V)\" in V; 50 % of 2 rows accepted"
    );
}

#[test]
fn state_column_gives_sign_of_magnitude() {
    let text = "Test (Sec),Amps,Volts,State\n0,1,3.9,C\n1,0,3.9,R\n2,2,3.7,D\n";
    let mut log = open(text).expect("opens");
    let mut currents = Vec::new();
    while let Some(row) = log.next_row().expect("reads") {
        assert!(row.is_ok());
        currents.push(log.values[0].1);
    }
    assert_eq!(currents, [Some(-1.0), Some(-0.0), Some(2.0)]);
}

#[test]
fn signed_current_after_long_charge_keeps_sign() {
    // In a charge of this format, a current of 1 A may be a magnitude or a signed current. The table begins with a
    // charge of 60,000 rows, so only the first discharge (-2 A) shows that the current is signed.
    let charge: String = (0..60_000).map(|n| format!("{n},1.0,3.9,CC Chg\n")).collect();
    let text =
        format!("Total Time(s),Current(A),Voltage(V),Step Type\n{charge}60000,-2,3.7,CC DChg\n60001,0.5,3.8,CC DChg\n");
    let mut log = open(&text).expect("opens");
    let mut last = Vec::new();
    while let Some(row) = log.next_row().expect("reads") {
        assert!(row.is_ok());
        last.push(log.values[0].1);
    }
    assert_eq!(last[59_999..], [Some(-1.0), Some(2.0), Some(-0.5)]);
}

#[test]
fn one_sided_beginning_does_not_decide_magnitude() {
    // One megabyte of discharge, then a charge. Three kinds of current: positive = discharge, positive = charge, and a
    // magnitude.
    let rows = |sign: f64, word: &str, count: usize| -> String {
        (0..count).map(|_| format!("{},3.7,{word}\n", sign * 2.0)).collect()
    };
    for (discharge, charge) in [(1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let all = rows(discharge, "DSG", 80_000) + &rows(charge, "CHG", 10);
        let numbered: String = all.lines().enumerate().map(|(n, row)| format!("{n},{row}\n")).collect();
        let mut log = open(&format!("Time (s),Current (A),Voltage (V),State\n{numbered}")).expect("opens");
        let mut currents = Vec::new();
        while let Some(row) = log.next_row().expect("reads") {
            assert!(row.is_ok());
            currents.push(log.values[0].1);
        }
        assert_eq!((currents[79_999], currents[80_009]), (Some(2.0), Some(-2.0)), "{discharge} {charge}");
    }
}

#[test]
fn late_state_does_not_make_signed_current_a_magnitude() {
    let charge: String = (0..10_000).map(|n| format!("{n},1.0,3.9,CC Chg\n")).collect();
    let discharge: String = (0..80).map(|n| format!("{},-5.0,3.7,CC DChg\n", 10_001 + n)).collect();
    let text = format!("Time (s),Current (A),Voltage (V),State\n{charge}10000,1.0,3.9,CC DChg\n{discharge}");
    let mut log = open(&text).expect("opens");
    while log.next_row().expect("reads").is_some() {}
    assert_eq!((log.reading().accepted(), log.values[0].1), (10_081, Some(5.0)), "{}", log.reading());
}

#[test]
fn other_unit_of_time_must_be_possible() {
    let options = CsvOptions { cells: 1, series: 1, capacity_ah: Some(2.6), ..CsvOptions::default() };
    // Loads, rests and charges of 20 minutes each; the voltage changes by less than 0.2 V in each.
    let sample = |n: u32| {
        let current_a = [1.3, 0.0, -1.0][n as usize / 120 % 3];
        (10.0 * f64::from(n), current_a, 3.8 - 0.001 * f64::from(n % 120) * current_a - 0.05 * current_a)
    };
    let read = |unit: &str, per_s: f64, strings: f64| {
        let row = |(time_s, current_a, voltage_v): (f64, f64, f64)| {
            format!("{},{},{voltage_v}\n", time_s * per_s, strings * current_a)
        };
        let text = format!("time_{unit},current_a,voltage_v\n{}", (0..720).map(|n| row(sample(n))).collect::<String>());
        let log = CsvLog::open(Box::new(std::io::Cursor::new(text)), Path::new("cell.csv"), &options);
        log.map_or_else(|error| error.to_string(), |log| log.reading().to_string())
    };
    for (stated, per_s, expected) in [
        ("ms", 1.0, "if it is in s, use"),
        ("us", 1.0, "if it is in s, use"),
        ("min", 1.0, "probably s:"),
        ("min", 1.0 / 3600.0, "if it is in h, use"),
        ("s", 1000.0, "probably ms:"),
    ] {
        let said = read(stated, per_s, 1.0);
        assert!(said.contains(expected), "{stated}: {said}");
    }
    assert!(
        ["s", "ms"]
            .map(|unit| read(unit, if unit == "s" { 1.0 } else { 1e3 }, 1.0))
            .iter()
            .all(|said| !said.contains("--column"))
    );
    let many = read("s", 1.0, 40.0);
    assert!(many.contains("all parallel cells") && !many.contains("probably"), "{many}");
}

#[test]
fn whole_seconds_in_the_range_of_dates_are_seconds() {
    for (divide, per_row, expected) in
        [(4, 1.0, "in s"), (1, 1.0 / 86_400.0, "in Excel days"), (4, 1e-5, "in Excel days")]
    {
        let row = |n: u32| format!("{},1,3.7\n", 45_000.0 + f64::from(n / divide) * per_row);
        let text = format!("Time,Current (A),Voltage (V)\n{}", (0..100).map(row).collect::<String>());
        let said = open(&text).expect("opens").reading().to_string();
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn magnitude_in_unknown_state_is_refused_by_name() {
    let mut log = open("Time (s),Current (A),Voltage (V),State\n0,1,3.9,C\n1,2,3.7,D\n2,2,3.7,Boost\n3,0,3.7,Boost\n")
        .expect("opens");
    let mut faults = Vec::new();
    while let Some(row) = log.next_row().expect("reads") {
        faults.extend(row.err().map(|fault| fault.to_string()));
    }
    let expected =
        "cell.csv:4: column State: found \"Boost\", must be charge, discharge or rest, because the current has no sign";
    assert_eq!(faults, [expected]);
}

#[test]
fn voltage_of_pack_is_preferred_for_pack() {
    let options = CsvOptions { cells: 4, series: 4, pack_total: true, ..CsvOptions::default() };
    let text = "Time (s),Current (A),Voltage (V),Pack Voltage (V)\n0,1,12.4,15\n";
    let log = CsvLog::open(Box::new(std::io::Cursor::new(text)), Path::new("x.csv"), &options).expect("opens");
    assert!(log.reading().to_string().contains("\"Pack Voltage (V)\""), "{}", log.reading());
    let text = "time/s\tEwe/V\tI/mA\tEcell/V\tTemperature (cell)\n0\t3.5\t10\t15\t25\n";
    let log = CsvLog::open(Box::new(std::io::Cursor::new(text)), Path::new("x.mpt"), &options).expect("opens");
    let said = log.reading().to_string();
    assert!(said.contains("\"Ecell/V\"") && said.contains("(cell)") && !said.contains("left out"), "{said}");
}

#[test]
fn commented_header_is_of_a_table() {
    assert!(is_table(Path::new("x.txt"), b"# Time [s]\tCurrent [A]\tVoltage [V]\n0\t1\t3.7\n"));
    assert!(!is_table(Path::new("x.log"), b"# Time, current, voltage and more\n(1.0) can0 123#00,\n"));
}

#[test]
fn late_first_time_costs_its_row_only() {
    for (times, bad) in [("4e9 1 2 3 4 5", "\"4e9\""), ("10 5 12 13 14 15", "\"5\"")] {
        let rows: String = times.split(' ').map(|time| format!("{time},1,3.7\n")).collect();
        let mut log = open(&format!("Time (s),Current (A),Voltage (V)\n{rows}")).expect("opens");
        let read: Vec<_> = std::iter::from_fn(|| log.next_row().expect("reads")).collect();
        let faults: Vec<String> = read.into_iter().filter_map(Result::err).map(|error| error.to_string()).collect();
        assert!(faults.len() == 1 && faults[0].contains(bad), "{faults:?}");
    }
}

#[test]
fn dates_without_a_clear_order_say_it() {
    for (days, expected) in [
        (vec!["03-04", "03-04"], "read as month/day"),
        (vec!["03-04", "04-04"], "read as day/month"),
        (vec!["13-04", "14-04"], ""),
        (vec!["04-13", "04-14", "31-01"], ""),
        (vec!["33-04", "03-04", "04-04"], "read as day/month"),
    ] {
        let rows: String = days.iter().map(|day| format!("{day}-2023 10:00:00,1,3.7\n")).collect();
        let said = open(&format!("Date,Current (A),Voltage (V)\n{rows}")).expect("opens").reading().to_string();
        assert!(said.contains(expected) && said.contains("dates are read") != expected.is_empty(), "{said}");
    }
}

#[test]
fn truncated_text_never_panics() {
    let whole = "EC-Lab ASCII FILE\r\nNb header lines : 3\r\ntime/s\tEcell/V\tI/mA\r\n0,0\t3,7\t10\r\n1,0\t3,7\t20\r\n";
    for length in 0..whole.len() {
        if let Ok(mut log) = open(&whole[..length]) {
            while log.next_row().expect("memory reads").is_some() {}
        }
    }
}
