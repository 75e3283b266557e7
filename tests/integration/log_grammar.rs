//! Tests the log grammars: every form of candump line, the journal, CSV, and arbitrary bytes.

use std::io::Write;
use std::path::{Path, PathBuf};

use packwatch::can::decode::Channel;
use packwatch::can::{CanId, Frame};
use packwatch::io::candump::{Line, StampDigits, parse_line, write_line};
use packwatch::io::csv_log::CsvOptions;
use packwatch::io::journal::JournalWriter;
use packwatch::io::log::{Batch, LogCounts, LogError, LogOptions, LogSource};
use packwatch::monitor::{BusEvent, Downtime, EventKind, Record, RecordKind};
use packwatch::quantity::{BusIndex, Timestamp};
use proptest::prelude::*;

use crate::support::rig::Rig;

fn frame_of(line: &str) -> Frame {
    match parse_line(line.as_bytes()).unwrap_or_else(|e| panic!("{line}: {}", e.describe(line.as_bytes()))) {
        Line::Frame { frame, .. } => frame,
        other => panic!("{line}: {other:?}"),
    }
}

fn std_id(id: u32) -> CanId {
    CanId::standard(id).expect("11 bits")
}

#[test]
fn every_frame_form_is_read() {
    let ext = CanId::extended(0x1234_5678).expect("29 bits");
    let table = [
        ("123#", Frame::classic(std_id(0x123), &[])),
        ("7FF#0011223344556677", Frame::classic(std_id(0x7FF), &[0, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77])),
        ("123#0011223344556677_F", Frame::classic(std_id(0x123), &[0, 0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77])),
        ("123#11.22.33", Frame::classic(std_id(0x123), &[0x11, 0x22, 0x33])),
        ("12345678#aB", Frame::classic(ext, &[0xAB])),
        ("00000123#AB", Frame::classic(CanId::extended(0x123).expect("29 bits"), &[0xAB])),
        ("123#R", Frame::remote(std_id(0x123), 0)),
        ("123#r5", Frame::remote(std_id(0x123), 5)),
        ("123#R8_9", Frame::remote(std_id(0x123), 8)),
        ("123##1", Frame::fd(std_id(0x123), true, false, &[])),
        ("12345678##611", Frame::fd(ext, false, true, &[0x11])),
        (
            "123##7000102030405060708090A0B",
            Frame::fd(std_id(0x123), true, true, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]),
        ),
        ("123##0000102030405060708", Frame::fd(std_id(0x123), false, false, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0])),
    ];
    for (text, frame) in table {
        let frame = frame.expect("a frame");
        for suffix in ["", " R", " T", "\r", "  ", " T\r"] {
            assert_eq!(frame_of(&format!("(1700000000.123456) can0 {text}{suffix}")), frame, "{text}{suffix:?}");
        }
    }
}

#[test]
fn unknown_interface_is_adopted_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.log");
    let lines =
        (0..100).map(|n| [&b"(1700000000.000000) can\xFF 123#11\n"[..], b"(1700000000.000000) can7 123#22\n"][n % 2]);
    std::fs::write(&path, lines.collect::<Vec<_>>().concat()).expect("written");
    let mut source = LogSource::new([path], options(false));
    source.adopt_foreign();
    let configured = source.interfaces().len();
    while source.next_record().expect("readable").is_some() {}
    assert_eq!(source.interfaces()[configured..], ["can\u{FFFD}", "can7"]);
    assert_eq!((source.counts().frames, source.counts().foreign.len()), (100, 0));
}

#[test]
fn timestamps_names_and_directions_are_read() {
    let parts = |line: &str| match parse_line(line.as_bytes()) {
        Ok(Line::Frame { time, interface, transmitted, .. }) => {
            (time.nanos(), String::from_utf8_lossy(interface).into_owned(), transmitted)
        }
        other => panic!("{line}: {other:?}"),
    };
    assert_eq!(parts("(1700000000.123456) can0 1FF#"), (1_700_000_000_123_456_000, "can0".into(), false));
    assert_eq!(parts("(1700000000.123456789)   vcan10 1FF# T"), (1_700_000_000_123_456_789, "vcan10".into(), true));
    assert_eq!(parts("(000.000001) can-x.1 1FF#00 R"), (1_000, "can-x.1".into(), false));
}

#[test]
fn lines_without_a_data_frame_are_distinguished() {
    let parse = |line: &'static str| parse_line(line.as_bytes()).unwrap_or_else(|e| panic!("{line}: {e}"));
    let time = Timestamp::from_nanos(1_000_000_000);
    let error = Line::ErrorFrame { time, interface: b"can0", class: 4 };
    assert_eq!(parse("(001.000000) can0 20000004#0004000000000000"), error);
    assert_eq!(parse("(001.000000) can0 00123#81:00:12345678#11223344"), Line::Xl { time, interface: b"can0" });
    let dropped = Line::Dropped { interface: b"can1", frames: 3 };
    assert_eq!(parse("DROPCOUNT: dropped 3 CAN frames on 'can1' socket (total drops 5)"), dropped);
    for other in ["", "# comment", "TICK (1.000000000)", "DROPCOUNT: nonsense", " (1.000000) can0 123#"] {
        assert_eq!(parse(other), Line::Other, "{other:?}");
    }
}

#[test]
fn malformed_line_reports_place_and_reason() {
    let table = [
        ("(", "column 2: found the end of the line, expected seconds"),
        ("(x.000000) can0 123#", "column 2: found \"x.000000) can0 123#\", expected seconds"),
        ("(1.0000) can0 123#", "column 8: found \") can0 123#\", expected a fraction of 6 or 9 digits"),
        ("(9999999999.000000) can0 123#", "expected a stamp below 9223372036 s"),
        ("(1.000000)can0 123#", "column 11"),
        ("(1.000000) can0", "column 16: found the end of the line, expected a space after the interface's name"),
        ("(1.000000) can0 1234#", "column 17: found \"1234#\", expected an identifier"),
        ("(1.000000) can0 800#", "column 17: found \"800#\", expected a standard identifier of at most 7FF"),
        ("(1.000000) can0 FFFFFFFF#", "column 17: found \"FFFFFFFF#\", expected an identifier of at most 1FFFFFFF"),
        ("(1.000000) can0 12G#", "column 19: found \"G#\", expected a hex digit"),
        ("(1.000000) can0 123#1", "column 21: found \"1\", expected two hex digits per byte"),
        ("(1.000000) can0 123#001122334455667788", "column 37: found \"88\", expected no more bytes"),
        ("(1.000000) can0 123#0011223344556677_8", "column 38: found \"8\", expected a raw length code of 9 to F"),
        ("(1.000000) can0 123#11_9", "column 23: found \"_9\", expected the frame's end"),
        ("(1.000000) can0 123#R9", "column 22: found \"9\", expected the frame's end"),
        ("(1.000000) can0 123##", "column 22: found the end of the line, expected one hex digit of FD flags"),
        ("(1.000000) can0 123#11 X", "column 24: found \"X\", expected R, T or the line's end"),
    ];
    for (line, wanted) in table {
        match parse_line(line.as_bytes()) {
            Err(error) => {
                let text = error.describe(line.as_bytes());
                assert!(text.contains(wanted), "{line}\n   says {text}\n wanted {wanted}");
            }
            Ok(read) => panic!("{line} was read as {read:?}"),
        }
    }
}

fn any_frame() -> impl Strategy<Value = Frame> {
    let id = prop_oneof![
        (0u32..=0x7FF).prop_map(|id| CanId::standard(id).expect("11 bits")),
        (0u32..=0x1FFF_FFFF).prop_map(|id| CanId::extended(id).expect("29 bits")),
    ];
    let fd_len = prop::sample::select(vec![0usize, 1, 7, 8, 12, 16, 20, 24, 32, 48, 64]);
    (id, 0..3, prop::collection::vec(any::<u8>(), 64), fd_len, any::<[bool; 2]>()).prop_map(
        |(id, kind, data, len, [brs, esi])| match kind {
            0 => Frame::classic(id, &data[..len.min(8)]).expect("at most 8"),
            1 => Frame::remote(id, len.min(8) as u8).expect("at most 8"),
            _ => Frame::fd(id, brs, esi, &data[..len]).expect("an FD length"),
        },
    )
}

proptest! {
    #[test]
    fn any_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = parse_line(&bytes).map_err(|e| e.describe(&bytes));
    }

    #[test]
    fn nearly_valid_lines_never_panic(text in "\\([0-9.]{0,14}\\) {0,2}[a-z0-9]{0,3} {0,2}[0-9A-Fa-fRr#:_. ]{0,40}") {
        let _ = parse_line(text.as_bytes()).map_err(|e| e.describe(text.as_bytes()));
    }

    #[test]
    fn written_line_reads_back(frame in any_frame(), nanos in any::<i64>()) {
        let time = Timestamp::from_nanos(nanos.max(-i64::MAX));
        let mut line = Vec::new();
        write_line(&mut line, time, StampDigits::Nanos, "can0", &frame).expect("memory");
        let wanted = Line::Frame { time, interface: b"can0", frame, transmitted: false };
        prop_assert_eq!(parse_line(line.strip_suffix(b"\n").expect("a line feed")), Ok(wanted));
    }

    #[test]
    fn any_file_is_read_to_end(bytes in prop::collection::vec(any::<u8>(), 0..400), name in "(a\\.log|a\\.csv)") {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(name);
        std::fs::write(&path, &bytes).expect("written");
        let _ = read(&[path], false, |_| {});
    }
}

/// Options whose row encoder writes the current to byte 0 and the cell voltage to byte 1.
fn options(strict: bool) -> LogOptions {
    LogOptions {
        interfaces: vec!["can0".into(), "can1".into()],
        channels: Vec::new(),
        strict,
        csv: CsvOptions { cells: 1, ..CsvOptions::default() },
        encode_row: Box::new(|values, frames| {
            let byte = |wanted: fn(&Channel) -> bool| {
                values.iter().find(|(c, _)| wanted(c)).and_then(|(_, v)| *v).map_or(0xFF, |v| (v * 10.0) as i8 as u8)
            };
            let data = [byte(|c| matches!(c, Channel::Current)), byte(|c| matches!(c, Channel::CellVoltage(_)))];
            frames.extend(Frame::classic(std_id(1), &data).map(|frame| (BusIndex(0), frame)));
            0
        }),
    }
}

fn read(
    paths: &[PathBuf],
    strict: bool,
    adapt: impl FnOnce(&mut LogOptions),
) -> Result<(Vec<Record>, LogCounts), LogError> {
    let mut options = options(strict);
    adapt(&mut options);
    let mut source = LogSource::new(paths.to_vec(), options);
    let mut records = Vec::new();
    while let Some(record) = source.next_record()? {
        records.push(record);
    }
    Ok((records, source.counts().clone()))
}

/// Reads the files in batches of up to `max` records.
fn read_batches(paths: &[PathBuf], strict: bool, max: usize) -> Result<(Vec<Record>, LogCounts), LogError> {
    let mut source = LogSource::new(paths.to_vec(), options(strict));
    let (mut batch, mut records) = (Batch::new(max), Vec::new());
    while source.next_batch(&mut batch)? {
        assert!((1..=max).contains(&batch.records().len()));
        assert_eq!(batch.carries_ticks(), source.carries_ticks());
        records.extend_from_slice(batch.records());
    }
    Ok((records, source.counts().clone()))
}

/// Log files with lines of every kind: usual, unusual, malformed, from other interfaces, and without a line end.
fn any_log() -> impl Strategy<Value = Vec<u8>> {
    let usual = "\\(000000000[0-9]\\.[0-9]{6}\\) can[012] [0-7][0-9A-F]{2}#([0-9A-F]{2}){0,8}\r?\n";
    let unusual = "\\([0-9]{1,3}\\.[0-9]{6}\\)  ?can[01] [0-7][0-9A-F]{2}#[R#]?([0-9A-F]{2}){0,9}( [RTX])?\n";
    let other = prop_oneof![
        "TICK \\(000000000[0-9]\\.[0-9]{9}\\)\n",
        "[ -~]{0,40}\n",
        "\\([0-9. a-z#]{0,40}",
        Just("\n".to_owned())
    ];
    let line = prop_oneof![8 => usual, 3 => unusual, 2 => other];
    let head = prop_oneof![4 => Just(String::new()), 1 => Just("PACKWATCH-JOURNAL 1\n".to_owned())];
    (head, prop::collection::vec(line, 0..40)).prop_map(|(head, lines)| (head + &lines.concat()).into_bytes())
}

proptest! {
    #[test]
    fn batches_equal_single_records(
        logs in prop::collection::vec(any_log(), 1..4),
        strict in any::<bool>(),
        max in prop::sample::select(vec![1, 3, Batch::MAX]),
    ) {
        let folder = tempfile::tempdir().expect("a folder");
        let paths: Vec<_> = logs.iter().zip(0..).map(|(log, n)| file(folder.path(), &format!("{n}.log"), log)).collect();
        let one_by_one = read(&paths, strict, |_| {});
        prop_assert_eq!(read_batches(&paths, strict, max), one_by_one);
        // With extra spaces, no line takes the fast path. The result must not change.
        let spread: Vec<_> = logs.iter().zip(0..).map(|(log, n)| {
            let text = String::from_utf8_lossy(log).replace(") can", ")  can");
            file(folder.path(), &format!("{n}.log"), text.as_bytes())
        }).collect();
        if !strict {
            // If the first line of a log contains a comma, the log is read as a table and rejected. Then both reads
            // must fail.
            match (read(&spread, strict, |_| {}), read_batches(&paths, strict, max)) {
                (Ok((wide, mut counts)), Ok((records, mut plain))) => {
                    (counts.first_bad_line, plain.first_bad_line) = (None, None);
                    prop_assert_eq!((records, plain), (wide, counts));
                }
                (wide, plain) => prop_assert!(wide.is_err() && plain.is_err()),
            }
        }
    }
}

#[test]
fn batch_ends_with_file_and_reports_ticks() {
    let folder = tempfile::tempdir().expect("a folder");
    let lines: String = (1..100).map(|n| format!("({n:010}.000000) can0 123#11\n")).collect();
    let plain = file(folder.path(), "a.log", lines.as_bytes());
    let journal =
        file(folder.path(), "b.log", format!("PACKWATCH-JOURNAL 1\n{}", lines.replace("(00", "(01")).as_bytes());
    let mut source = LogSource::new(vec![plain, journal], options(true));
    let (mut batch, mut reported) = (Batch::new(Batch::MAX), [0, 0]);
    while source.next_batch(&mut batch).expect("read") {
        reported[usize::from(batch.carries_ticks())] += batch.records().len();
    }
    assert_eq!(reported, [99, 99]);
}

fn file(folder: &Path, name: &str, text: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, text).expect("written");
    path
}

fn gap(seconds: i64) -> Record {
    Record::unknown_gap(Timestamp::from_nanos(seconds * 1_000_000_000))
}

fn millis(records: &[Record]) -> Vec<i64> {
    records.iter().map(|r| r.time.nanos() / 1_000_000).collect()
}

#[test]
fn malformed_lines_are_counted_and_first_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let text =
        b"(1.000000) can0 123#11\n(1.1) can0 123#11\n(1.2000000) x\n# note\n(1.300000) can7 123#\n(2.000000) can1 1#";
    let path = file(folder.path(), "a.log", text);
    let (records, counts) = read(std::slice::from_ref(&path), false, |_| {}).expect("read");
    assert_eq!(millis(&records), [1000]);
    assert_eq!((counts.lines, counts.frames, counts.bad_lines, counts.ignored_lines), (6, 1, 3, 1));
    assert_eq!(counts.foreign.get("can7"), Some(&1));
    let first = counts.first_bad_line.expect("shown");
    assert!(
        first.ends_with("a.log:2: column 5: found \") can0 123#11\", expected a fraction of 6 or 9 digits"),
        "{first}"
    );
    let strict = read(&[path], true, |_| {}).expect_err("strict");
    assert_eq!(strict.to_string(), first);
}

#[test]
fn compressed_logs_match_and_truncation_is_reported() {
    let folder = tempfile::tempdir().expect("a folder");
    let text: Vec<u8> = (0..5000).flat_map(|n| format!("({n}.000000) can0 123#{:04X}\n", n).into_bytes()).collect();
    let plain = read(&[file(folder.path(), "a.log", &text)], true, |_| {}).expect("plain");
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gz.write_all(&text).expect("packed");
    let gz = gz.finish().expect("packed");
    let zst = zstd::encode_all(text.as_slice(), 1).expect("packed");
    for (name, bytes) in [("a.log.gz", &gz), ("b", &zst)] {
        assert_eq!(read(&[file(folder.path(), name, bytes)], true, |_| {}).expect(name), plain, "{name}");
    }
    let (records, counts) = read(&[file(folder.path(), "torn.gz", &gz[..gz.len() / 2])], false, |_| {}).expect("torn");
    assert!(!records.is_empty() && records.len() < 5000);
    assert!(counts.bad_lines >= 1 && counts.first_bad_line.expect("shown").contains("torn.gz"));
}

#[test]
fn earlier_log_follows_unknown_gap() {
    let folder = tempfile::tempdir().expect("a folder");
    let first = file(folder.path(), "a.log", b"(100.000000) can0 123#\n(105.000000) can0 123#\n");
    let second = file(folder.path(), "b.log", b"(000.500000) can0 123#\n(002.500000) can0 123#\n");
    let (records, counts) = read(&[first, second], true, |_| {}).expect("read");
    assert_eq!(records[2], gap(106));
    assert_eq!(millis(&records), [100_000, 105_000, 106_000, 106_000, 108_000]);
    assert_eq!((counts.unknown_gaps, counts.time_backwards), (1, 0));
}

#[test]
fn journal_reads_back_as_written() {
    let frame = Frame::classic(std_id(0x123), &[1, 2, 3]).expect("a frame");
    let at = Timestamp::from_nanos;
    let events = [
        BusEvent::Up,
        BusEvent::Down,
        BusEvent::Missing,
        BusEvent::Dropped { frames: 7 },
        BusEvent::ErrorFrame { class: 0x1FFF_0004 },
        BusEvent::SendFailed { frames: u64::MAX },
    ];
    let mut inputs = vec![
        Record::frame(at(1_700_000_000_123_456_789), BusIndex(1), &frame),
        Record::tick(at(1_700_000_000_130_000_000)),
        Record::unknown_gap(at(1_700_000_000_130_000_001)),
        Record::frame(at(1_700_000_000_120_000_000), BusIndex(0), &frame),
    ];
    inputs.extend(events.map(|event| Record::bus(at(1_700_000_001_000_000_000), BusIndex(1), event)));
    let mut journal = JournalWriter::new(Vec::new(), vec!["can0".into(), "can1".into()]).expect("memory");
    let aways = [Downtime::Seconds(0.1), Downtime::AsStamped, Downtime::Unknown];
    let taken_up = at(1_700_000_000_000_000_000);
    aways.iter().try_for_each(|away| journal.restored(taken_up, *away)).expect("memory");
    inputs.iter().try_for_each(|input| journal.append(input)).expect("memory");
    let text = journal.into_inner();
    let folder = tempfile::tempdir().expect("a folder");
    let (records, counts) = read(&[file(folder.path(), "j", &text)], true, |_| {}).expect("read");
    assert_eq!(records[..3], aways.map(|away| Record::restore(taken_up, away)));
    assert_eq!(records[3..], inputs);
    assert_eq!((counts.bad_lines, counts.ignored_lines, counts.time_backwards), (0, 1, 1));

    // The last line is cut off. It must not be read as a complete but shorter line.
    let (records, counts) = read(&[file(folder.path(), "t", &text[..text.len() - 2])], false, |_| {}).expect("read");
    assert_eq!((records.len(), counts.bad_lines), (inputs.len() + 2, 1));
}

/// A frame, then two notes in candump's form with the largest possible number of lost frames.
const MOST_DROPPED: &str = "(1.000000) can0 123#11\n\
    DROPCOUNT: dropped 18446744073709551615 CAN frames on 'can0' socket (total drops 18446744073709551615)\n\
    DROPCOUNT: dropped 18446744073709551615 CAN frames on 'can0' socket (total drops 18446744073709551615)\n";

#[test]
fn lost_frame_counts_saturate() {
    let folder = tempfile::tempdir().expect("a folder");
    let candump = file(folder.path(), "a.log", MOST_DROPPED.as_bytes());
    let lost = Record::bus(Timestamp::from_nanos(1_000_000_000), BusIndex(0), BusEvent::Dropped { frames: u64::MAX });
    let one_by_one = read(std::slice::from_ref(&candump), true, |_| {}).expect("read");
    assert_eq!(one_by_one.0[1..], [lost, lost], "each line must be a record with its own number");
    assert_eq!((one_by_one.1.dropped_frames, one_by_one.1.bad_lines), (u64::MAX, 0));
    assert_eq!(read_batches(&[candump], true, Batch::MAX).expect("read"), one_by_one);
    let line = "BUS (1.000000000) can0 dropped 18446744073709551615\n";
    let journal = file(folder.path(), "j", format!("PACKWATCH-JOURNAL 1\n{line}{line}").as_bytes());
    let (records, counts) = read(&[journal], true, |_| {}).expect("read");
    assert_eq!((records, counts.bad_lines), (vec![lost, lost], 0));
    // If the number of lost frames exceeds the largest possible number, the line is invalid.
    let beyond = MOST_DROPPED.replace("dropped 18446744073709551615", "dropped 18446744073709551616");
    let (records, counts) = read(&[file(folder.path(), "b.log", beyond.as_bytes())], false, |_| {}).expect("read");
    assert_eq!((records.len(), counts.dropped_frames, counts.ignored_lines), (1, 0, 2));
}

#[test]
fn lost_frame_counts_leave_statistics_unchanged() {
    let mut rig = Rig::new("");
    rig.seconds(1);
    let before = rig.monitor.statistics().clone();
    let notes = [BusEvent::Dropped { frames: u64::MAX }, BusEvent::SendFailed { frames: u64::MAX }];
    rig.events.clear();
    for event in [notes[0], notes[0], notes[1], notes[1]] {
        let time = rig.now();
        rig.give(Record::bus(time, BusIndex(0), event));
    }
    let noted = rig.events.iter().filter_map(|event| match event.kind {
        EventKind::Bus { what, .. } => Some(what),
        _ => None,
    });
    assert_eq!(noted.collect::<Vec<_>>(), [notes[0], notes[0], notes[1], notes[1]]);
    assert_eq!(*rig.monitor.statistics(), before, "lost frames must not change the statistics");
    rig.seconds(1);
    assert_eq!(
        rig.monitor.statistics().buses[0].frames,
        before.buses[0].frames + 20,
        "the monitor must continue to count"
    );
}

#[test]
fn malformed_journal_lines_are_counted() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = b"PACKWATCH-JOURNAL 1\nTICK (1.0)\nTICK (1.000000000) x\nBUS (1.000000000) can0 gone\nBUS (1.000000000) can0 up\nGAP\n";
    let (records, counts) = read(&[file(folder.path(), "j", text)], false, |_| {}).expect("read");
    assert_eq!((records.len(), counts.bad_lines, counts.ignored_lines), (1, 3, 2));
    let newer = file(folder.path(), "n", b"PACKWATCH-JOURNAL 2\n");
    assert!(read(&[newer], false, |_| {}).expect_err("a newer version is rejected").to_string().contains("must be"));
}

#[test]
fn csv_rows_become_frames_bad_fields_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = b"time_s,current_a,voltage_v,temperature_c\n0,1.5,4.0,25\n1.25,,3.9,25\n2,NaN,3.9,25\n3,1,oops,25\n4,1\n5,2,3.8,\n6,1";
    let path = file(folder.path(), "a.csv", text);
    let (records, counts) = read(std::slice::from_ref(&path), false, |_| {}).expect("read");
    assert_eq!(millis(&records), [0, 1250, 2000, 4000, 5000]);
    assert_eq!((counts.lines, counts.frames, counts.bad_lines), (7, 5, 2));
    let first = counts.first_bad_line.expect("shown");
    assert!(
        first.ends_with("a.csv:5: column voltage_v: found \"oops\", must be a finite number, empty, - or n/a"),
        "{first}"
    );
    let data = |record: &Record| match &record.kind {
        RecordKind::Frame { frame, .. } => frame.data().to_vec(),
        other => panic!("{other:?}"),
    };
    assert_eq!((data(&records[0]), data(&records[1])), (vec![15, 40], vec![0xFF, 39]));
    assert_eq!((data(&records[2]), data(&records[3])), (vec![0xFF, 39], vec![10, 0xFF]));
    let (flipped, _) = read(&[path], false, |o| o.csv.charge_positive = Some(true)).expect("read");
    assert_eq!(data(&flipped[0])[0] as i8, -15);
}

#[test]
fn csv_columns_are_mapped_and_missing_one_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = file(folder.path(), "a.csv", b"t,I (A),U1,U2\n0,1,3,4\n");
    let error = read(std::slice::from_ref(&path), false, |_| {}).expect_err("one cell is configured");
    assert!(
        error.to_string().ends_with(
            "2 columns of cell voltages, must be 1 as in the configuration, numbered from 0 or 1; found \
                        t,I (A),U1,U2; name them with --column voltage=NAME"
        ),
        "{error}"
    );
    let columns = [("time", "t"), ("current", "I (A)"), ("voltage{n}", "U{n}")].map(|(r, c)| (r.into(), c.into()));
    let (records, _) = read(&[path], false, |o| (o.csv.columns, o.csv.cells) = (columns.to_vec(), 2)).expect("mapped");
    assert_eq!(records.len(), 1);
}

#[test]
fn csv_sections_follow_gaps_without_start_times() {
    let folder = tempfile::tempdir().expect("a folder");
    let text = b"cycle,time_s,current_a,voltage_v\n0,0,1,4\n0,10,1,4\n1,0,1,4\n1,5,1,4\n";
    let path = file(folder.path(), "a.csv", text);
    let (records, _) = read(std::slice::from_ref(&path), true, |_| {}).expect("read");
    assert_eq!(records[2], gap(11));
    assert_eq!(millis(&records), [0, 10_000, 11_000, 11_000, 16_000]);
    let table = file(folder.path(), "t.csv", b"cycle,start\n0,1970-01-01T00:01:00\n1,1970-01-01T01:00:00.5\n");
    let (records, counts) = read(&[path], true, |o| o.csv.start_times = Some(table)).expect("read");
    assert_eq!(millis(&records), [60_000, 70_000, 3_600_500, 3_605_500]);
    assert_eq!(counts.unknown_gaps, 0);
}
