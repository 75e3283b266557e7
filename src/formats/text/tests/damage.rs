//! Tests damaged logs: no panic, and everything before the damage is read.

use super::{content, read_as, shown};
use crate::{Format, Item};

/// A short log of each format.
const LOGS: [&str; 10] = [
    " (1700000000.000000)  can0  RX - -  100   [2]  05 A2\n (1700000000.001000)  can0  RX B -  18FF1234  [03]  05 00 A2\n",
    "(000.000000) can0 100#0501\n(000.001000) can0 110#DE0F\n(000.000500) can0 100#2100\n(000.000400) can0 18FF1234##1210011\n",
    "date Tue Nov 14 10:13:20.000 pm 2023\nbase dec  timestamps absolute\n 0.1 1  256 Rx   d 2 162 19  Length = 1\n 0.2 CANFD 1 Rx 100 Name 1 0 3 3 16 255 101 0 0 1000\n",
    ";$FILEVERSION=2.1\r\n;$STARTTIME=45244.925\r\n;$COLUMNS=N,O,T,B,I,d,R,L,D\r\n 1 0.000 DT 1 0100 Rx - 2 05 A2\r\n 2 1.000 FD 1 18FF1234 Rx - 3 05 A2 01\r\n",
    "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n1000,100,false,Rx,0,2,05,A2,\n2000,18FF1234,true,Rx,1,2,05,A2,\n",
    "timestamp,arbitration_id,extended,remote,error,dlc,data\n1.5,0x100,0,0,0,2,BQA=\n2.5,0x100,0,0,0,3,BQAB\n",
    "# Logger type: CL2000\n# Time: 20231114T221319\nTimestamp;Type;ID;Data\n14T221320500;0;326;0102\n14T221321500;1;18ff1234;010203\n",
    "1524311386.811100 1R11 100 01 02\n1524311386.9 2T29 18FF1234 05 06 07\n",
    "Chn Identifier Flg   DLC  D0...1\n 0    00000065         2  01  FF   1.500000 R\n 1    18FF1234 X       2  60 61  2.500000 T\n",
    "***BUSMASTER Ver 3.2.2***\n***START DATE AND TIME 14:11:2023 22:13:20:000***\n***SYSTEM MODE***\n22:13:21:5000 Rx 1 0x100 s 2 05 A2\n22:13:21:6000 Rx 1 0x18FF1234 x 2 06 A2\n",
];

fn frames(format: Format, log: &[u8]) -> Vec<String> {
    let (items, channels) = read_as(format, log);
    items.iter().filter(|item| matches!(item, Item::Frame { .. })).map(|item| shown(item, &channels)).collect()
}

#[test]
fn log_cut_at_any_byte_gives_frames_before_the_cut() {
    for log in LOGS {
        let format = Format::recognise(log.as_bytes()).unwrap_or_else(|| panic!("recognised: {log}"));
        let whole = frames(format, log.as_bytes());
        assert!(whole.len() >= 2, "{log}");
        for cut in 0..log.len() {
            let lines = log[..cut].matches('\n').count();
            let complete = log.split_inclusive('\n').take(lines).collect::<String>();
            let expected = frames(format, complete.as_bytes());
            let found = frames(format, &log.as_bytes()[..cut]);
            assert!(found.starts_with(&expected), "{format:?} cut at {cut}: {found:?}");
            // The cut line gives either nothing or a frame. If the format states no length, this frame may have lost
            // bytes at its end.
            let rest = &found[expected.len()..];
            let is_prefix = |frame: &String| whole[expected.len()].starts_with(frame.as_str());
            assert!(rest.len() <= 1 && rest.iter().all(is_prefix), "{format:?} cut at {cut}: {rest:?}");
        }
    }
}

#[test]
fn garbage_lines_are_reported_and_the_next_line_is_read() {
    for log in LOGS {
        let format = Format::recognise(log.as_bytes()).expect("recognised");
        let whole = frames(format, log.as_bytes());
        for garbage in [&b"0.5 \xFF\xFE\x00\x1B[31m"[..], b"()", b"(", b";$COLUMNS=", b",,,,,,,,,,,,", b"1)", b"***"] {
            let lines = log.as_bytes().split_inclusive(|byte| *byte == b'\n');
            let last = lines.clone().count() - 1;
            let damaged: Vec<u8> = lines
                .enumerate()
                .flat_map(|(n, line)| if n == last { [garbage, b"\n", line].concat() } else { line.to_vec() })
                .collect();
            let found = frames(format, &damaged);
            assert!(found.starts_with(&whole[..whole.len() - 1]), "{format:?} {garbage:?}: {found:?}");
            let columns_are_lost = garbage == b";$COLUMNS=" && format == Format::Trc;
            assert!(found == whole || columns_are_lost, "{format:?} {garbage:?}: {found:?}");
        }
    }
}

#[test]
fn any_change_of_a_byte_causes_no_panic() {
    for log in LOGS {
        let format = Format::recognise(log.as_bytes()).expect("recognised");
        for at in 0..log.len() {
            for byte in [0, b' ', b'9', b'-', b'x', b'\n', b'\r', 0x1B, 0xFF] {
                let mut changed = log.as_bytes().to_vec();
                changed[at] = byte;
                let _ = Format::recognise(&changed);
                // A candump log without stamps is refused.
                if format != Format::Candump {
                    let _ = read_as(format, &changed);
                }
            }
        }
    }
}

#[test]
fn overlong_line_is_skipped_and_reported() {
    let line = format!("0.5 1  100 Rx d 1 05 // {}\n", "x".repeat(300_000));
    let log = format!("base hex timestamps absolute\n0.1 1 100 Rx d 1 01\n{line}0.9 1 100 Rx d 1 09\n");
    assert_eq!(content(log.as_bytes()), ["0.1 0 100 01", "longer than 256 KiB", "0.9 0 100 09"]);
}

#[test]
fn large_times_and_backward_steps_are_kept() {
    let log =
        "base hex timestamps absolute\n1000000000.000001 1 100 Rx d 0\n5.0 1 100 Rx d 0\n9223372036.9 2 100 Rx d 0\n";
    let seen = content(log.as_bytes());
    assert_eq!(seen[..2], ["1000000000.000001 0 100", "5 0 100"]);
    assert!(seen[2].contains("a time below 9223372036 s"), "{seen:?}");
    let relative = "base hex timestamps relative\n9000000000.0 1 1 Rx d 0\n9000000000.0 1 1 Rx d 0\n1.0 1 1 Rx d 0\n";
    let seen = content(relative.as_bytes());
    assert!(
        seen[0] == "9000000000 0 001" && seen[1].contains("a time below") && seen[2] == "9000000001 0 001",
        "{seen:?}"
    );
}

#[test]
fn time_of_day_beyond_any_clock_is_bad() {
    let head = "***BUSMASTER Ver 3.2.2***\n***START DATE AND TIME 14:11:2023 22:13:20:000***\n***SYSTEM MODE***\n";
    let log = format!("{head}{}", "2562046:00:00:0000 Rx 1 0x100 s 1 05\n".repeat(3));
    assert!(frames(Format::Busmaster, log.as_bytes()).is_empty(), "no time is beyond the range of stamps");
}

#[test]
fn channels_beyond_the_limit_are_refused() {
    let lines: String = (0..300).map(|n| format!("0.5 {} 100 Rx d 0\n", n + 1)).collect();
    let seen = content(format!("base hex timestamps absolute\n{lines}").as_bytes());
    assert_eq!(seen.iter().filter(|line| line.contains("at most 256 channels")).count(), 44);
    let name = format!(" (1.0)  can0  100   [0]\n (1.0)  {}  100   [0]\n (1.0)  c\u{7}n  100   [0]\n", "x".repeat(65));
    assert_eq!(content(name.as_bytes()).iter().filter(|line| line.contains("at most 256 channels")).count(), 2);
}
