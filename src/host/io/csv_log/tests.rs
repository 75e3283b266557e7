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
    // The first rows are a charge, so only the first discharge shows that the current has a sign.
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
fn truncated_text_never_panics() {
    let whole = "EC-Lab ASCII FILE\r\nNb header lines : 3\r\ntime/s\tEcell/V\tI/mA\r\n0,0\t3,7\t10\r\n1,0\t3,7\t20\r\n";
    for length in 0..whole.len() {
        if let Ok(mut log) = open(&whole[..length]) {
            while log.next_row().expect("memory reads").is_some() {}
        }
    }
}
