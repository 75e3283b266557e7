//! Tests the forms of lines that tools write.

use super::{check, content, read};
use crate::{Channel, Format, Item, Source, foreign};

/// A line of an ASC log, read in base hex, and the item that it gives.
const ASC: [(&str, &str); 30] = [
    ("0.5 1  100             Rx   d 8 05 00 A2 00 19 AA 00 00", "0.5 0 100 05 00 A2 00 19 AA 00 00"),
    ("0.5 2  18FF1234x       Tx   d 2 05 00 Length = 704000 BitCount = 145 ID = 419369524x", "0.5 1 18FF1234 05 00"),
    ("0.5 0  594\tRx   d 2 34 21 ", "0.5 0 594 34 21"),
    ("0.5 1  0x2A0 Rx   d 2 AA bb // Name", "0.5 0 2A0 AA BB"),
    ("0.5 1  C8x             rx   d 0", "0.5 0 000000C8"),
    ("0.5 1  100 Rx d f 01 02 03 04 05 06 07 08", "0.5 0 100 01 02 03 04 05 06 07 08"),
    ("0.5 1  200             Tx   r", "0.5 0 200 R0"),
    ("0.5 1  200             Tx   r 8  Length = 1 BitCount = 2", "0.5 0 200 R8"),
    ("0.5 1  ErrorFrame\tECC: 10100010", "0.5 0 error 0"),
    (
        "0.5 2  ErrorFrame Flags = 0xe CodeExt = 0x20a2 Code = 0x82 ID = 0 DLC = 0 Position = 5 Length = 11300",
        "0.5 1 error 0",
    ),
    (
        "0.5 CANFD   1 Rx        100                                   1 0 9 12 01 02 03 04 05 06 07 08 09 0a 0b 0c   100000  214   303000 80000000 46500250",
        "0.5 0 100 FB 01 02 03 04 05 06 07 08 09 0A 0B 0C",
    ),
    ("0.5 CANFD   2 Tx 1FFFFFFFx  Motor_Data  0 1 2 2 01 02 0 0 5000 0 0 0 0 0", "0.5 1 1FFFFFFF FE 01 02"),
    ("0.5 CANFD 1 Rx 100 - 0 0 1 1 FF", "0.5 0 100 F FF"),
    (
        "0.5 CANFD 1 Rx 100 1 0 9 9 01 02 03 04 05 06 07 08 09 // Name",
        "0.5 0 100 FB 01 02 03 04 05 06 07 08 09 00 00 00",
    ),
    (
        "0.5 CANFD   1 Rx 100 0 0 8 8 01 02 03 04 05 06 07 08 130000 130 0 0 0 0 0 0",
        "0.5 0 100 01 02 03 04 05 06 07 08",
    ),
    ("0.5 CANFD   1 Rx 100 0 0 8 0 130000 130 10 0 0 0 0 0", "0.5 0 100 R8"),
    (
        "0.5 CANFD 1  101             Tx   1 0 d 2 2 F1 F2  Length = 209000 BitCount = 128 ID = 257",
        "0.5 0 101 FB F1 F2",
    ),
    ("0.5 CANFD 1  100             Tx   1 0 r 8  Length = 138000 BitCount = 57 ID = 256", "0.5 0 100 R8"),
    (
        "0.5 CANFD 2 Tx ErrorFrame Not Acknowledge error, dominant error flag fffe c7 31ca Data 45 ff 1 0 f 64",
        "0.5 1 error 0",
    ),
    ("0.5 CANXL   2 Rx   CBFF   243215   176      432  Name 2 2 e1 89 174 00000000 00000000", "0.5 1 432 E1 89"),
    (
        "0.5 CANXL   1 Rx   FEFF   243215   176      18FF0001x   a 16 01 02 03 04 05 06 07 08 09 0a 0b 0c 0d 0e 0f 10 8 123123 00003000 00000000",
        "0.5 0 18FF0001 FB 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F 10",
    ),
    ("0.5 CANXL   1 Rx   XLFF   984438   4656      101   02 0 3 4 1 1f96 00 00000000 01 02 03 04", "XL"),
    ("0.5 1  100 Rx d 2 01", "column 21: found the end of the line, expected a data byte of 2 hex digits"),
    ("0.5 1  800 Rx d 1 01", "column 8: found \"800 Rx d 1 01\", expected an identifier of at most 7FF, or 1FFFFFFFx"),
    ("0.5 1  100 Rx z", "column 15: found \"z\", expected d or r"),
    ("0.5 1  100", "column 11: found the end of the line, expected Rx, Tx or TxRq"),
    ("0.5 300  Statistic: D 1", "other"),
    (
        "9999999999.0 1 100 Rx d 0",
        "column 1: found \"9999999999.0 1 100 Rx d \"..., expected a time below 9223372036 s",
    ),
    ("0.5x 1 100 Rx d 0", "column 1: found \"0.5x 1 100 Rx d 0\", expected a time below 9223372036 s"),
    ("garbage", "column 1: found \"garbage\", expected a time, a comment //, or a header line such as date or base"),
];

#[test]
fn asc_lines_give_their_frames() {
    for (line, expected) in ASC {
        let log = format!("base hex  timestamps absolute\n{line}\n");
        let (items, channels) = read(log.as_bytes());
        assert_eq!(super::shown(&items[1], &channels), expected, "{line}");
    }
}

#[test]
fn asc_lines_without_frames_are_not_errors() {
    let log = "date Thu Nov 26 21:59:59.677 2026\nbase hex  timestamps absolute\nno internal events logged\n// version 9.0.0\n\
               Begin Triggerblock Tue Nov 14 22:13:20.0 2023\n   0.000000 Start of measurement\n\
               0.1 CAN 1 Status:chip status error active\n0.1 1  Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 0.00%\n\
               0.1 1  100 TxRq d 2 01 02\n0.1 CANFD 1 TxRq 100 0 0 1 1 01\n0.1 1  OverloadFrame\n\
               0.1 1  J1939TP FEE3p 6 0 0 - Rx d 3 A0 0F A6\n0.1 L4 1 Tx 1 254 checksum = 63\n0.1 Li SleepModeEvent 0\n\
               0.1 Fr RMSG 0 0 1 1 50 1 Rx 0\n0.1 ETH 1 Rx 40:0102\n0.1 SV: 2 0 1 ::x = 1\n0.1 log trigger event\n\
               0.1 Comment: 0 text\n\nEnd TriggerBlock\n";
    let (items, _) = read(log.as_bytes());
    assert!(items.iter().all(|item| *item == Item::Other), "{items:?}");
}

#[test]
fn asc_decimal_base_reads_decimal_numbers() {
    check(
        "base dec  timestamps absolute\n0.5 1  1792x           Tx   d 3   2  16 255\n0.5 1 256 Rx d 1 256\n",
        &["0.5 0 00000700 02 10 FF", "column 18: found \"256\", expected a data byte of 0 to 255"],
    );
    // The last byte of a line without line end may have been cut.
    assert!(content(b"base dec  timestamps absolute\n0.5 1  256 Rx d 1 16")[0].contains("data byte of 0 to 255"));
}

#[test]
fn asc_relative_stamps_are_added_up() {
    check(
        "date Thu Jan 1 00:00:10 1970\nbase hex  timestamps relative\n0.5 1 1 Rx d 0\n0.25 1 Statistic: D 1\n0.25 1 2 Rx d 0\n",
        &["10.5 0 001", "11 0 002"],
    );
}

#[test]
fn asc_trigger_block_restarts_time_only_if_stamps_restart() {
    let block = |at: &str, stamp: &str| {
        format!("Begin Triggerblock Thu Jan 1 00:{at} 1970\n{stamp} 1 1 Rx d 0\nEnd TriggerBlock\n")
    };
    let log =
        |second: &str| format!("date Fri Jan 2 00:00:00 1970\n{}{}", block("01:00", "5.0"), block("02:00", second));
    check(&log("6.0"), &["65 0 001", "66 0 001"]);
    check(&log("0.5"), &["65 0 001", "120.5 0 001"]);
    check("date Wed, 08 Nov 2023 21:15:06 GMT\nbegin triggerblock\n1.0 0 1 Rx d 0\n", &["1699478107 0 001"]);
}

#[test]
fn asc_unknown_date_is_reported_and_time_counts_from_zero() {
    let seen = content("base hex timestamps absolute\ndate whenever\n1.0 1 1 Rx d 0\n".as_bytes());
    assert!(seen[0].contains("expected a date such as"), "{seen:?}");
    assert_eq!(seen[1], "1 0 001");
}

#[test]
fn trc_versions_give_the_same_frames() {
    let data = "0300 3 01 02 03";
    let v10 = format!(
        ";   Start time: 01.01.1970 00:00:10.500\n;\n 1)  1500  {data}\n 2)  1600  0008 4 ERROR 00 19 08 08\n 3) 1700 FFFFFFFF 4 00 00 00 04 -- -- -- -- BUSLIGHT\n 4) 1800 18EFC034 3 RTR\n"
    );
    let v11 = format!(
        ";$FILEVERSION=1.1\n;$STARTTIME=25569.0001215278\n 1)  1500.0  Rx {data}\n 2) 1600.0 Error 0008 4 00 19 08 08\n 3) 1700.0 Warng FFFFFFFF 4 00 00 00 04 BUSLIGHT\n 4) 1800.0 Tx 18EFC034 3 RTR\n"
    );
    let v12 = format!(
        ";$FILEVERSION=1.2\n;$STARTTIME=25569.0001215278;\n 1) 1500.000 1 Rx {data}\n 2) 1600.000 1 Error 0008 4 00 19 08 08\n 3) 1700.000 1 Warng FFFFFFFF 4 00 00 00 04\n 4) 1800.000 1 Rx 18EFC034 3 RTR\n"
    );
    let v13 = ";$FILEVERSION=1.3\n;$STARTTIME=25569.0001215278\n 1) 1500.000 1 Rx 0300 - 3 01 02 03\n 2) 1600.000 1 Error 0008 - 4 00 19 08 08\n 3) 1700.0 1 Warng FFFFFFFF - 4 00 00 00 04\n 4) 1800.0 1 Rx 18EFC034 - 3 RTR\n".to_owned();
    let v20 = ";$FILEVERSION=2.0\n;$STARTTIME=25569.00012152778\n;$COLUMNS=N,O,T,I,d,l,D\n 1 1500.000 DT 0300 Rx 3 01 02 03\n 2 1600.000 ER Rx 04 00 02 00 00\n 3 1700.0 ST Rx 00 00 00 08\n 3 1700.0 EC Rx 02 02\n 4 1800.0 RR 18EFC034 Rx 3\n".to_owned();
    let v21 = ";$FILEVERSION=2.1\n;$STARTTIME=25569.00012152778\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n 1 1500.000 DT 1 0300 Rx - 3 01 02 03\n 2 1600.000 ER 1 - Rx - 5 04 00 02 00 00\n 3 1650.0 EV - an event\n 3 1700.0 ST 1 - Rx - 4 00 00 00 08\n 4 1800.0 RR 1 18EFC034 Rx - 3\n".to_owned();
    for log in [v10, v11, v12, v13, v20, v21] {
        check(&log, &["12 0 300 01 02 03", "12.1 0 error 0", "12.3 0 18EFC034 R3"]);
        check(&log.replace('\n', "\r\n"), &["12 0 300 01 02 03", "12.1 0 error 0", "12.3 0 18EFC034 R3"]);
    }
}

#[test]
fn trc_fd_lengths_are_codes_or_bytes() {
    let bytes = "01 02 03 04 05 06 07 08 09 0A 0B 0C";
    let log = format!(
        ";$FILEVERSION=2.0\n;$COLUMNS=N,O,T,I,d,l,D\n 1 1.0 FD 0100 Rx 12 {bytes}\n;$FILEVERSION=2.1\n 2 2.0 FB 1 0100 Rx - 9 {bytes}\n\
         ;$FILEVERSION=3.0\n;$COLUMNS=N,O,T,B,I,d,R,V,S,A,r,s,L,D\n 3 3.0 BI 2 100 Rx - - - - - - 9 {bytes}\n 4 4.0 XL 1 100 Tx - 00 03 00000456 0 0 3 03 11\n"
    );
    let frame = |start: &str| format!("{start} {bytes}");
    check(&log, &[&frame("0.001 0 100 F"), &frame("0.002 0 100 FB"), &frame("0.003 1 100 FBE"), "XL"]);
}

#[test]
fn trc_start_time_is_exact_to_its_resolution() {
    // Start times in days. python-can writes enough digits for microseconds. PEAK's tools write ten decimals, which are
    // enough for milliseconds.
    let cases = [
        ("45244.92592592593", "1700000000"),
        ("45244.92592739403", "1700000000.126844"),
        ("37704.5364870833", "1048510352.484"),
        ("25569", "0"),
    ];
    for (days, expected) in cases {
        let log = format!(";$FILEVERSION=2.1\n;$STARTTIME={days}\n 1 0.000 DT 1 0300 Rx - 0\n");
        check(&log, &[&format!("{expected} 0 300")]);
    }
}

/// A line of candump's screen text and the item that it gives.
const SCREEN: [(&str, &str); 17] = [
    (" (0.5)  RX0  A8   [2]  05 00", "0.5 RX0 0A8 05 00"),
    (" (1700000000.5)  can0  100   [2]  05 A2", "1700000000.5 can0 100 05 A2"),
    (" (1700000000.500000001)  can0  100   [0]", "1700000000.500000001 can0 100"),
    (" (2023-11-14 22:13:20.500000)  can0  100   [2]  05 A2", "1700000000.5 can0 100 05 A2"),
    (" (1700000000.5)  vcan10  RX - -  18FF1234   [2]  05 A2", "1700000000.5 vcan10 18FF1234 05 A2"),
    (" (1700000000.5)  can0  TX B E       100  [02]  05 A2", "1700000000.5 can0 100 FBE 05 A2"),
    (" (1700000000.5)  can0  TX  100   [2]  05 A2", "1700000000.5 can0 100 05 A2"),
    (
        " (1700000000.5)  can0  100  [12]  01 02 03 04 05 06 07 08 09 0A 0B 0C",
        "1700000000.5 can0 100 F 01 02 03 04 05 06 07 08 09 0A 0B 0C",
    ),
    (" (1700000000.5)  can0  100   [3]  41 42 20                  'AB '", "1700000000.5 can0 100 41 42 20"),
    (" (1700000000.5)  can0  100   [2]  A2`05                  `..`", "1700000000.5 can0 100 05 A2"),
    (" (1700000000.5)  can0  100   [2]  00000101 10100010", "1700000000.5 can0 100 05 A2"),
    (" (1700000000.5)  can0  100   {f}  01 02 03 04 05 06 07 08", "1700000000.5 can0 100 01 02 03 04 05 06 07 08"),
    (" (1700000000.5)  can0  100   [4]  remote request", "1700000000.5 can0 100 R4"),
    (" (1700000000.5)  can0  20000088   [8]  00 00 08 00 00 00 00 00   ERRORFRAME", "1700000000.5 can0 error 88"),
    (" \u{1b}[1m\u{1b}[34m(1700000000.5)  can0  100   [1]  05\u{1b}[0m", "1700000000.5 can0 100 05"),
    (" (1700000000.5)  can0       100 [2048] (00|11:22:12345678) 01 02 ...", "XL"),
    (
        " (1700000000.5)  can0  100   [2]  05",
        "column 37: found the end of the line, expected a data byte of 2 hex digits or 8 bits",
    ),
];

#[test]
fn candump_screen_lines_give_their_frames() {
    for (line, expected) in SCREEN {
        check(
            &format!(
                "$ candump -ta any\n (1700000000.0)  can9  1FFFFFFF   [0]\n\tbus-error\nDROPCOUNT: dropped 1 CAN frame on 'can0' socket (total drops 1)\n{line}\n"
            ),
            &["1700000000 can9 1FFFFFFF", expected],
        );
    }
}

#[test]
fn candump_deltas_are_added_up_in_text_and_logs() {
    let text = " (000.000000)  can0  100   [1]  01\n (000.001000)  can0  100   [1]  02\n (000.000500)  can0  100   [1]  03\n (000.000400)  can0  100   [1]  04\n";
    assert_eq!(Format::recognise(text.as_bytes()), Some(Format::CandumpDeltas));
    let expected = ["0 can0 100 01", "0.001 can0 100 02", "0.0015 can0 100 03", "0.0019 can0 100 04"];
    check(text, &expected);
    let log =
        "(000.000000) can0 100#01\n(000.001000) can0 100#02\n(000.000500) can0 100#03\n(000.000400) can0 100#04\n";
    check(log, &expected);
    let forms = "(000.000000) can0 18FF1234##3010203\n(000.001000) can0 100#R4\n(000.000500) can0 20000004#0004\n(000.000400) can0 100#11.22\n(000.000300) can0 00123#81:00:12345678#11\n";
    check(
        forms,
        &["0 can0 18FF1234 FBE 01 02 03", "0.001 can0 100 R4", "0.0015 can0 error 4", "0.0019 can0 100 11 22", "XL"],
    );
    let equal = "(000.010000) can0 100#01\n".repeat(20);
    assert_eq!(Format::recognise(equal.as_bytes()), Some(Format::CandumpDeltas), "the stamps do not grow");
}

#[test]
fn candump_logs_from_zero_or_1970_are_left_to_their_reader() {
    let zero = "(000.000000) can0 100#01\n(000.001000) can0 100#02\n(001.001000) can1 100#03\n(001.000500) can0 100#04\n(001.100500) can0 100#04\n";
    let absolute =
        "(1700000000.000000) can0 100#01 R\n(1700000000.000000) can0 100#02 T\n(1700000000.000000) can0 100#02 T\n";
    let coarse: String = (0..40).map(|n| format!("(000.{:02}0000) can0 100#{n:02X}\n", n / 4)).collect();
    let seconds = "(166.000000) can0 100#01\n".repeat(20);
    for log in [zero, absolute, &coarse, &seconds, "PACKWATCH-JOURNAL 1\ndate Tue Nov 14 22:13:20 2023\n"] {
        assert_eq!(Format::recognise(log.as_bytes()), None, "{log}");
    }
}

#[test]
fn candump_text_without_times_is_refused_with_advice() {
    let text = b"  can0  100   [8]  05 00 A2 00 19 AA 00 00\n";
    assert_eq!(Format::recognise(text), Some(Format::Candump));
    let opened = Format::Candump.open(Source { reader: Box::new(&text[..]), file: None });
    let message = opened.err().expect("refused").to_string();
    assert!(message.contains("has no times") && message.contains("candump -L"), "{message}");
}

#[test]
fn gvret_columns_follow_the_header() {
    let new = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n500000,000005EB,false,Rx,1,2,E8,45,\n";
    let old = "Time Stamp,ID,Extended,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n500000,5EB,false,1,2,E8,45,,,,,,,\n";
    let quoted = "\"Time Stamp\";\"ID\";\"Extended\";\"Bus\";\"LEN\";\"D1\";\"D2\"\n\"0.5\";\"0x5EB\";\"0\";\"1\";\"2\";\"E8\";\"45\"\n";
    for log in [new, old, quoted] {
        check(log, &["0.5 1 5EB E8 45"]);
    }
    let decimal =
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n500000,1515,false,Rx,0,2,232,69,\n1000000,2048,false,Rx,0,1,1,\n";
    check(decimal, &["0.5 0 5EB E8 45", "1 0 00000800 01"]);
    let bad = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2\n500000,1,false,Rx,0,2,E8,\nx,1,false,Rx,0,0,\n";
    let seen = content(bad.as_bytes());
    assert!(
        seen[0].contains("as many data bytes as the row's length states") && seen[1].contains("a time"),
        "{seen:?}"
    );
}

#[test]
fn tables_of_other_tools_give_their_frames() {
    let adapter = "NO    Direction  Time Scale        Frame Type      Frame Format        Frame ID    Length        ~ Data \r\n0     ~Receive     ~23:59:59:900     ~Data frame     ~Standard frame     ~000005eb     ~2     ~e8 45      ~\r\n1     ~Receive     ~00:00:00:100     ~Remote frame     ~Extended frame     ~00000100     ~4     ~      ~\r\n".replace('~', "\0");
    check(&adapter, &["86399.9 0 5EB E8 45", "86400.1 0 00000100 R4"]);
    let parsed = "ParserFlags\tCh\tCounter\tT/R\tTime\tFlags\tCAN ID\tLen\tData\tParser Name\n1\t0\t1\tRX\t565214\t\t0x000005eb\t2\t0xe8 45 \tDefault\t\n";
    check(parsed, &["565.214 0 5EB E8 45"]);
    let carbus = "@ TEXT @ 3 @ 64 @ 0 @ 1149 @ 7459 @ 00:00:07.459 @\r# $LocalTime=11:19:54.503\r26,641405\t1\t00000004\t5EB\t2\tE8 45\t00000000\t  \t\r";
    check(carbus, &["26.641405 1 5EB E8 45"]);
    check("Time Stamp,ID,Extended,Bus,DLC,D1,D2\n500000,5eb,0,1,1,e8,0\n", &["0.5 1 5EB E8"]);
    let rows: String = (0..30).map(|n| format!("{},5eb,0,1,1,e8\n", 500 + 3 * n)).collect();
    let log = format!("Time Stamp,ID,Extended,Bus,LEN,D1\n{rows}");
    assert_eq!(content(log.as_bytes())[1], "0.503 1 5EB E8", "microseconds would be faster than any bus");
    check("time,addr,bus,data\n0.5,0x5eb,0,0xe845\n", &["0.5 0 5EB E8 45"]);
}

#[test]
fn units_of_tables_follow_the_header() {
    for (name, time) in [
        ("Time (ms)", "1010.5"),
        ("Time (ns)", "1010500000"),
        ("Time (\u{3bc}s)", "1010500"),
        ("Time (microseconds)", "1010500"),
        ("timestamp[s]", "1.0105"),
        ("Time", "00:01.0105"),
        ("Time", "0:00:01.0105"),
    ] {
        check(&format!("{name},ID,DLC,Data\n{time},5EB,2,E845\n"), &["1.0105 0 5EB E8 45"]);
    }
    let rows = |times: &[&str]| times.iter().map(|time| format!("{time},5EB,1,E8\n")).collect::<String>();
    let whole = rows(&["0.5", "1", "1.5"]);
    check(&format!("time,ID,Len,Data\n{whole}"), &["0.5 0 5EB E8", "1 0 5EB E8", "1.5 0 5EB E8"]);
    let unix = rows(&["1700000000", "1700000001", "1700000002"]);
    check(&format!("time,ID,Len,Data\n{unix}"), &["1700000000 0 5EB E8", "1700000001 0 5EB E8", "1700000002 0 5EB E8"]);
    for other in ["Time (min),ID,Len,Data", "Time,ID,Bus,Data,Current,Voltage", "Time,ID,Len,D1_V"] {
        assert_eq!(Format::recognise(other.as_bytes()), None, "{other}");
    }
    let late = rows(&["23:59:59.9", "0:00:00", "23:59:59.95", "0:00:00.1"]);
    let found = content(format!("Time,ID,Len,Data\n{late}").as_bytes());
    assert_eq!(found, ["86399.9 0 5EB E8", "86400 0 5EB E8", "86399.95 0 5EB E8", "86400.1 0 5EB E8"]);
}

#[test]
fn rows_of_tables_that_contradict_themselves_are_bad() {
    let log = "Time,Frame Type,ID,Extended,DLC,Data\n0.1,Data,5EB,0,1,E845\n0.2,Error frame,5EB,0,2,E845\n0.3,Data,5EB,yes,9,010203040506070809101112\n0.4,Data,5EB,0,2,E845";
    let found = content(log.as_bytes());
    assert!(found[0].contains("as many data bytes as the row's length states"), "{found:?}");
    assert_eq!(
        found[1..],
        ["0.2 0 error 0", "0.3 0 000005EB F 01 02 03 04 05 06 07 08 09 10 11 12", "0.4 0 5EB E8 45"]
    );
    let cut = content(b"time,addr,bus,data\n0.6,0x1A,0,0x0102");
    assert!(cut[0].contains("a line end after the data"), "{cut:?}");
    check("Time Stamp,ID,Extended,Bus,LEN,D1\n500000,1515,0,1,1,32,\n", &["0.5 1 5EB 20"]);
}

#[test]
fn python_can_csv_rows_give_their_frames() {
    let header = "timestamp,arbitration_id,extended,remote,error,dlc,data\n";
    let rows = "2.5e-05,0x100,0,0,0,2,BQA=\n1.0,0x18ff1234,1,1,0,4,\n2.0,0x4,0,0,1,0,\n3.0,0x100,0,0,0,12,AQIDBAUGBwgJCgsM\n4.0,0x100,0,0,0,3,BQA=\n";
    check(
        &format!("{header}{rows}"),
        &[
            "0.000025 0 100 05 00",
            "1 0 18FF1234 R4",
            "2 0 error 4",
            "3 0 100 F 01 02 03 04 05 06 07 08 09 0A 0B 0C",
            "column 19: found \"BQA=\", expected as many bytes in base64 as dlc states",
        ],
    );
}

#[test]
fn css_stamps_are_completed_from_the_header() {
    let log = |settings: &str, rows: &str| format!("# Logger type: CL2000\n# Time: 20231114T221319\n{settings}{rows}");
    let row = "0;326;0102\n";
    let cases = [
        ("Timestamp;Type;ID;Data\n14T221320500;", row),
        ("Timestamp;Type;ID;Data\n22:13:20500;", row),
        ("Timestamp;Type;ID;Data\n2023/11/14T22:13:20.500;", row),
        ("Timestamp;Type;ID;Data\n1700000000.5;", row),
    ];
    for (head, row) in cases {
        check(&log("", &format!("{head}{row}")), &["1700000000.5 0 326 01 02"]);
    }
    check(
        &log("", "Timestamp,Type,ID,Length,Data\n30T235959000,9,18ff1234,1,05\n01T000000000,0,1,0,\n"),
        &["1701388799 0 18FF1234 05", "1701388800 0 001"],
    );
    check(
        &log("", "Timestamp;Type;ID;Data\n23:59:59000;0;1;\n00:00:00500;0;2;\n"),
        &["1700006399 0 001", "1700006400.5 0 002"],
    );
}

#[test]
fn crtd_records_give_their_frames() {
    let log = "1524311386.811100 CXX OVMS CRTD\n1524311386.811100 1R11 100 01 02\n1524311386.9 2T29 18FF1234 05\n1524311387.0 R11 7FF\n1524311387.0 CEV event\n1524311387.0 R11 8FF 01\n";
    let seen = content(log.as_bytes());
    assert_eq!(seen[..3], ["1524311386.8111 0 100 01 02", "1524311386.9 1 18FF1234 05", "1524311387 0 7FF"]);
    assert!(seen.len() == 4 && seen[3].contains("an identifier of at most 7FF (11)"), "{seen:?}");
}

#[test]
fn canking_rows_give_their_frames() {
    let header = "Chn Identifier Flg   DLC  D0...1...2...3...4...5...6..D7       Time     Dir\n";
    let log = format!(
        "{header} 0    00000065         2  01  FF                              1.5 R\n 1    00002102 X       1  60      2.5 T\n 0    00000000            ErrorFrame                          29.095270 R\n 0 00000065 R 2 3.0 R\nlogging started\n 0 65 1 01 3.5\n"
    );
    let seen = content(log.as_bytes());
    assert_eq!(seen[..4], ["1.5 0 065 01 FF", "2.5 1 00002102 60", "29.09527 0 error 0", "3 0 065 R2"]);
    assert!(seen.len() == 5 && seen[4].contains("expected R or T after the time"), "a cut time is not used: {seen:?}");
    let decimal = format!("{header} 0    101         2  1  255                              1.5 R\n");
    check(&decimal, &["1.5 0 065 01 FF"]);
}

#[test]
fn busmaster_times_follow_the_mode() {
    let log = |mode: &str, rows: &str| {
        format!(
            "***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n***START DATE AND TIME 14:11:2023 22:13:20:000***\n***HEX***\n***{mode} MODE***\n{rows}"
        )
    };
    let rows = "00:00:01:5000 Rx 1 0x100 s 2 05 A2\n00:00:00:5000 Tx 2 0x18FF1234 xr 4\n";
    check(&log("ABSOLUTE", rows), &["1700000001.5 0 100 05 A2", "1700000000.5 1 18FF1234 R4"]);
    check(&log("RELATIVE", rows), &["1700000001.5 0 100 05 A2", "1700000002 1 18FF1234 R4"]);
    let rows = "22:13:21:5000 Rx 1 0x100 s 0\n00:00:00:0000 Rx 1 0x100 s 0\n";
    check(&log("SYSTEM", rows), &["1700000001.5 0 100", "1700006400 0 100"]);
}

#[test]
fn formats_are_recognised_after_marks_comments_and_blank_lines() {
    let asc = "\u{feff}\r\n// a comment\r\n# another\r\n\r\ndate Die Dez 21 11:29:01 2004\r\nbase hex  timestamps absolute\r\n1.0 1 1 Rx d 0\r\n";
    check(asc, &["1103628542 0 001"]);
    let utf16: Vec<u8> = asc.encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert_eq!(content(&utf16), ["1103628542 0 001"]);
    assert_eq!(Format::recognise(b"5.0 1  100 Rx d 1 05\n"), Some(Format::Asc), "the header was cut off");
    let tables =
        ["time_s,current_a,voltage_v\n0,1,3.5\n", "timestamp,id,data\n", "date,base\n2024-01-01,1\n", "", "hello\n"];
    for table in tables {
        assert_eq!(Format::recognise(table.as_bytes()), None, "{table}");
    }
}

#[test]
fn channels_are_numbered_from_the_first_of_their_format() {
    let (_, channels) = read(b"base hex timestamps absolute\n0.1 2 1 Rx d 0\n0.1 1 1 Rx d 0\n");
    assert_eq!(channels, [Channel::Number { written: 2, index: 1 }, Channel::Number { written: 1, index: 0 }]);
    let (_, channels) = read(b"base hex timestamps absolute\n0.1 0 1 Rx d 0\n0.1 1 1 Rx d 0\n");
    assert_eq!(channels, [Channel::Number { written: 0, index: 0 }, Channel::Number { written: 1, index: 1 }]);
}

#[test]
fn foreign_files_are_named_with_a_converter() {
    let name = |head: &[u8]| foreign(head).map(|(name, _)| name);
    assert_eq!(name(b"MDF     3.30    "), Some("MDF 3"));
    assert_eq!(name(b"PK\x03\x04\x14\0\x06\0\x08\0\0\0!\0[Content_Types].xml"), Some("Excel workbook (.xlsx)"));
    assert_eq!(name(b"PK\x03\x04drive.asc"), Some("ZIP archive"));
    assert_eq!(name(b"SQLite format 3\0"), Some("SQLite database"));
    assert_eq!(name(&[&[0; 257], &b"ustar"[..]].concat()), Some("TAR archive"));
    assert_eq!(name(b"MDF     4.10    "), None);
    assert_eq!(name(b"(1700000000.0) can0 100#01\n"), None);
    assert_eq!(name(b"ASCII Trace IXXAT Automation GmbH\n"), Some("IXXAT trace"));
    assert_eq!(name(b"ID,Data Bytes\n0000021A,FE 36\n"), Some("list of frames without times"));
    assert_eq!(name(b"//----\nMicrochip Technology Inc.\nCAN BUS Analyzer\n"), Some("Microchip CAN BUS Analyzer log"));
    assert_eq!(name(b""), None);
}
