//! One drive in the export formats of cyclers and applications. Headers, preambles and conventions are those of real
//! exports.

use std::fmt::Write as _;

/// One second of the drive, discharge positive.
#[derive(Clone, Copy)]
pub(super) struct Sample {
    pub(super) second: u32,
    pub(super) current_ma: i32,
    pub(super) voltage_mv: i32,
}

/// A drive of 15 minutes with a cell of 2.6 Ah: loads, regeneration and pauses.
pub(super) fn drive() -> Vec<Sample> {
    let mut charge_mas = 0.0;
    let sample = |second: u32| {
        let load = match second % 40 {
            0..=9 => 2600,
            10..=17 => 900 + 150 * (second % 7) as i32,
            18..=23 => -1300,
            _ => 0,
        };
        charge_mas += f64::from(load);
        let voltage_mv = 3950.0 - 900.0 * charge_mas / (2600.0 * 3600.0) - 0.035 * f64::from(load);
        Sample { second, current_ma: load, voltage_mv: voltage_mv.round() as i32 }
    };
    (0..900).map(sample).collect()
}

/// An export: its name, its file name, its text, and whether it contains the temperature (25 degrees C).
pub(super) struct Export {
    pub(super) name: &'static str,
    pub(super) file: &'static str,
    pub(super) bytes: Vec<u8>,
    pub(super) has_temperature: bool,
}

fn table(head: &str, rows: &[Sample], row: impl Fn(Sample) -> String, end: &str) -> Vec<u8> {
    let mut text = format!("{head}{end}");
    for &sample in rows {
        write!(text, "{}{end}", row(sample)).unwrap();
    }
    text.into_bytes()
}

fn ampere(current_ma: i32) -> String {
    format!("{:.3}", f64::from(current_ma) / 1000.0)
}

fn volt(s: Sample) -> String {
    format!("{:.3}", f64::from(s.voltage_mv) / 1000.0)
}

fn clock(second: u32) -> String {
    format!("{:02}:{:02}:{:02}", second / 3600, second / 60 % 60, second % 60)
}

fn state(s: Sample, words: [&'static str; 3]) -> &'static str {
    words[match s.current_ma {
        0 => 2,
        1.. => 0,
        _ => 1,
    }]
}

fn latin1(text: &[u8]) -> Vec<u8> {
    String::from_utf8_lossy(text).chars().map(|c| c as u32 as u8).collect()
}

fn utf16(text: &[u8]) -> Vec<u8> {
    let units: Vec<u16> = String::from_utf8_lossy(text).encode_utf16().collect();
    [0xFF, 0xFE].into_iter().chain(units.into_iter().flat_map(u16::to_le_bytes)).collect()
}

/// packwatch's own table, with or without temperature.
pub(super) fn plain(rows: &[Sample], has_temperature: bool) -> Vec<u8> {
    let (head, end) = if has_temperature { (",temperature_c", ",25") } else { ("", "") };
    let row = |s: Sample| format!("{},{},{}{end}", s.second, ampere(s.current_ma), volt(s));
    table(&format!("time_s,current_a,voltage_v{head}"), rows, row, "\n")
}

pub(super) fn all(rows: &[Sample]) -> Vec<Export> {
    let mut all = cyclers(rows);
    all.extend(magnitudes(rows));
    all.extend(programs(rows));
    all.extend(forms(rows));
    all.extend(headers(rows));
    all
}

fn export(name: &'static str, file: &'static str, has_temperature: bool, bytes: Vec<u8>) -> Export {
    Export { name, file, bytes, has_temperature }
}

/// Exports of cyclers, in which a charge is positive.
fn cyclers(rows: &[Sample]) -> Vec<Export> {
    let bdf = |s: Sample| format!("{},{},{},25", s.second, volt(s), ampere(-s.current_ma));
    let arbin = |s: Sample| {
        format!(
            "{},{}.000,11/14/2023 22:13:20,1.0,1,1,{},{},0.1,0.2,25.0",
            s.second + 1,
            s.second,
            ampere(-s.current_ma),
            volt(s)
        )
    };
    let neware = |s: Sample| {
        let step = state(s, ["CC DChg", "CC Chg", "Rest"]);
        format!("{},1,1,{step},0,{},{},{}", s.second + 1, clock(s.second), -s.current_ma, volt(s))
    };
    let mpt = |s: Sample| {
        let time = format!("{:.4}", f64::from(s.second)).replace('.', ",");
        let (ma, v) = (format!("{},000", -s.current_ma), volt(s).replace('.', ","));
        format!("1\t1\t0\t{time}\t{ma}\t{v}\t{ma}\t0,0\t25,0")
    };
    let mpt_head = "EC-Lab ASCII FILE\r\nNb header lines : 6\r\n\r\nModulo Bat, channel 1, I/mA\r\nAcquisition started on : \
        11/14/2023 22:13:20\r\nmode\tox/red\terror\ttime/s\tcontrol/mA\tEcell/V\t<I>/mA\tdQ/mA.h\tTemperature/\u{b0}C";
    let digatron = |s: Sample| {
        let step = state(s, ["DCH", "CHA", "PAU"]);
        format!(
            "11/14/2023 10:13:20 PM,1,{step},{}.000,0,1,HPPC,{},{},25.0,0.1",
            clock(s.second),
            volt(s),
            ampere(-s.current_ma)
        )
    };
    let digatron_head = "Cell,LG\nTest,HPPC\n\nTime Stamp,Step,Status,Prog Time,Step Time,Cycle,Procedure,Voltage,Current,\
        Temperature,AhAccu\n,,,,,,,[V],[A],[C],[Ah]";
    let basytec = |s: Sample| {
        let hours = f64::from(s.second) / 3600.0;
        format!(
            "{hours:.9}\t1\t0\t7\t{}\t{}\t{}\t0.1\t25.0",
            state(s, ["Discharge", "Charge", "Pause"]),
            volt(s),
            ampere(-s.current_ma)
        )
    };
    let basytec_head = "~Resultfile from Basytec Battery Test System\r\n~\r\n~Battery: LG\r\n~Time[h]\tDataSet\tt-Step[h]\tLine\t\
        Command\tU[V]\tI[A]\tAh[Ah]\tT1[\u{b0}C]";
    vec![
        export(
            "BDF labels",
            "a.bdf.csv",
            true,
            table("Test Time / s,Voltage / V,Current / A,Surface Temperature T1 / degC", rows, bdf, "\n"),
        ),
        export(
            "BDF machine names",
            "a.bdf",
            true,
            table("test_time_second,voltage_volt,current_ampere,surface_temperature_t1_celsius", rows, bdf, "\n"),
        ),
        export(
            "BDF in mA",
            "b.bdf.csv",
            false,
            table(
                "Test Time / s,Current / mA,Voltage / V",
                rows,
                |s| format!("{},{},{}", s.second, -s.current_ma, volt(s)),
                "\n",
            ),
        ),
        export(
            "Arbin",
            "a.csv",
            true,
            table(
                "Data_Point,Test_Time(s),Date_Time,Step_Time(s),Step_Index,Cycle_Index,Current(A),Voltage(V),Charge_Capacity(Ah),Discharge_Capacity(Ah),Aux_Temperature(\u{b0}C)_1",
                rows,
                arbin,
                "\r\n",
            ),
        ),
        export(
            "Arbin MITS Pro",
            "b.csv",
            true,
            table(
                "Data Point,Test Time (s),Date Time,Step Time (s),Step Index,Cycle Index,Current (A),Voltage (V),Charge Capacity (Ah),Discharge Capacity (Ah),Aux_Temperature_1 (C)",
                rows,
                arbin,
                "\n",
            ),
        ),
        export(
            "Neware",
            "c.csv",
            false,
            table(
                "DataPoint,Cycle Index,Step Index,Step Type,Time,Total Time,Current(mA),Voltage(V)",
                rows,
                neware,
                "\n",
            ),
        ),
        export("BioLogic", "a.mpt", true, latin1(&table(mpt_head, rows, mpt, "\r\n"))),
        export("Digatron", "d.csv", true, table(digatron_head, rows, digatron, "\n")),
        export(
            "Digatron with units in names",
            "e.csv",
            true,
            table(
                "Timestamp,Step,Status,Program Duration#s,Cycle,Voltage#V,Current#A,T1#degC",
                rows,
                |s| {
                    format!(
                        "2023-11-14T22:13:20+00:00,1,{},{},1,{},{},25",
                        state(s, ["DCH", "CHA", "PAU"]),
                        s.second,
                        volt(s),
                        ampere(-s.current_ma)
                    )
                },
                "\n",
            ),
        ),
        export("Basytec", "a.txt", true, latin1(&table(basytec_head, rows, basytec, "\r\n"))),
        export(
            "Landt",
            "f.csv",
            false,
            table(
                "cycle_index,step_index,test_time_s,step_time_s,current_a,voltage_v",
                rows,
                |s| format!("1,1,{},0,{},{}", s.second, ampere(-s.current_ma), volt(s)),
                "\n",
            ),
        ),
    ]
}

/// Exports that contain the magnitude of the current and a state (charge, discharge, rest).
fn magnitudes(rows: &[Sample]) -> Vec<Export> {
    let maccor = |time: String, s: Sample| {
        let step = state(s, ["D", "C", "R"]);
        format!(
            "{}\t1\t1\t{time}\t0\t0.1\t0.2\t{}\t{}\t{step}\t0\t11/14/2023 22:13:20",
            s.second + 1,
            ampere(s.current_ma.abs()),
            volt(s)
        )
    };
    let minutes = |s: Sample| maccor(format!("{:.6}", f64::from(s.second) / 60.0), s);
    let days = |s: Sample| maccor(format!("  0d {}.00", clock(s.second)), s);
    let head = |time: &str| {
        format!(
            "Today's Date\t11/14/2023\tDate of Test:\t11/14/2023\tFilename:\tcell.001\r\nRec#\tCyc#\tStep\t{time}\tStep (Min)\tAmp-hr\tWatt-hr\tAmps\tVolts\tState\tES\tDPt Time"
        )
    };
    let neware = |s: Sample| {
        let step = state(s, ["CC_DChg", "CCCV_Chg", "Rest"]);
        format!("{},{step},1,1,{},{},0-{}", s.second + 1, s.current_ma.abs(), volt(s), clock(s.second))
    };
    vec![
        export("Maccor in minutes", "a.001.txt", false, table(&head("Test (Min)"), rows, minutes, "\r\n")),
        export("Maccor with days", "g.csv", false, table(&head("TestTime"), rows, days, "\n")),
        export("Maccor without a unit", "h.csv", false, table(&head("TestTime"), rows, minutes, "\n")),
        export(
            "Neware with magnitude",
            "i.csv",
            false,
            table("Record number,State,Cycle,Steps,Current(mA),Voltage(V),Total Time(h:min:s.ms)", rows, neware, "\n"),
        ),
    ]
}

/// Exports of programs and applications.
fn programs(rows: &[Sample]) -> Vec<Export> {
    let pybamm = |s: Sample| format!("{}.0,{},{},298.15,0.1", s.second, ampere(s.current_ma), volt(s));
    let cellpy = |s: Sample| {
        format!("{};{};2023-11-14 22:13:20;{};{};1;1", s.second + 1, s.second, ampere(-s.current_ma), volt(s))
    };
    let fahrenheit = |s: Sample| format!("{}, {}, {}, 77.0", s.second, s.current_ma, volt(s));
    let dated = |s: Sample| {
        format!("2023-11-14 22:{:02}:{:02},{},{}", 13 + s.second / 60, s.second % 60, volt(s), ampere(s.current_ma))
    };
    vec![
        export(
            "PyBaMM",
            "j.csv",
            true,
            table(
                "Time [s],Current [A],Terminal voltage [V],X-averaged cell temperature [K],Discharge capacity [A.h]",
                rows,
                pybamm,
                "\n",
            ),
        ),
        export(
            "cellpy",
            "k.csv",
            false,
            table("data_point;test_time;date_time;current;voltage;cycle_index;step_index", rows, cellpy, "\n"),
        ),
        export(
            "application",
            "l.csv",
            true,
            table("Time, Current (mA), Voltage [V], Temp (F)", rows, fahrenheit, "\n"),
        ),
        export(
            "application with dates",
            "m.csv",
            false,
            table("DateTime,Pack Voltage (V),Pack Current (A)", rows, dated, "\n"),
        ),
        export(
            "minutes",
            "n.csv",
            false,
            table(
                "Elapsed (min),I [mA],U [mV]",
                rows,
                |s| format!("{:.9},{},{}", f64::from(s.second) / 60.0, s.current_ma, s.voltage_mv),
                "\n",
            ),
        ),
        export(
            "Unix ms",
            "o.csv",
            false,
            table(
                "timestamp,current,voltage",
                rows,
                |s| {
                    format!(
                        "{},{},{}",
                        1_700_000_000_000_i64 + 1000 * i64::from(s.second),
                        ampere(s.current_ma),
                        volt(s)
                    )
                },
                "\n",
            ),
        ),
        export(
            "Unix ns",
            "p.csv",
            false,
            table(
                "timestamp,current,voltage",
                rows,
                |s| {
                    format!(
                        "{},{},{}",
                        1_700_000_000_000_000_000_i64 + 1_000_000_000 * i64::from(s.second),
                        ampere(s.current_ma),
                        volt(s)
                    )
                },
                "\n",
            ),
        ),
    ]
}

/// Exports with various encodings, separators and line ends.
fn forms(rows: &[Sample]) -> Vec<Export> {
    let german =
        |s: Sample| format!("{},0;{};{}", s.second, ampere(s.current_ma).replace('.', ","), volt(s).replace('.', ","));
    let mut mixed = String::from_utf8(table("\u{feff}Time (s);Current (A);Voltage (V)", rows, german, "\n")).unwrap();
    for line in [3, 5, 200] {
        let place = mixed.match_indices('\n').nth(line).unwrap().0;
        mixed.insert(place, '\r');
    }
    let tab = |s: Sample| format!("{}\t{}\t{}", s.second, ampere(s.current_ma), volt(s));
    let second_row =
        table("Time,Current,Voltage\ns,mA,V", rows, |s| format!("{},{},{}", s.second, s.current_ma, volt(s)), "\n");
    vec![
        export("decimal comma, byte order mark, mixed line ends", "q.csv", false, mixed.into_bytes()),
        export(
            "UTF-16 with tabs",
            "r.txt",
            false,
            utf16(&table("Time (s)\tCurrent (A)\tVoltage (V)", rows, tab, "\r\n")),
        ),
        export("units in a second row", "s.csv", false, second_row),
        export(
            "quoted, with a separator line",
            "t.csv",
            false,
            table(
                "sep=;\n\"Time (s)\";\"Current (A)\";\"Voltage (V)\"",
                rows,
                |s| format!("\"{}\";\"{}\";\"{}\"", s.second, ampere(s.current_ma), volt(s)),
                "\n",
            ),
        ),
    ]
}

/// Exports with several possible columns for a value, or with unusual rows.
fn headers(rows: &[Sample]) -> Vec<Export> {
    type Row<'a> = (&'static str, &'static str, &'a str, bool, &'a dyn Fn(Sample) -> String);
    let (a, v) = (|s: Sample| ampere(s.current_ma), volt);
    let charged = |s: Sample| ampere(-s.current_ma);
    let magnitude =
        |s: Sample, words| format!("{},{},{},{}", s.second, ampere(s.current_ma.abs()), v(s), state(s, words));
    let day = |s: Sample| format!("14-Nov-2023 22:{:02}:{:02}.000", 13 + s.second / 60, s.second % 60);
    let all: [Row<'_>; 14] = [
        (
            "Landt",
            "1.csv",
            "Record,TestTime,StepTime,Current/mA,Capacity/mAh,Voltage/V,Temperature/\u{2103},SysTime",
            true,
            &|s| {
                format!("1,{},{},{},0,{},25,2023-11-14 22:13:20", clock(s.second), clock(s.second), -s.current_ma, v(s))
            },
        ),
        (
            "PEC",
            "2.csv",
            "Test,Cell,Cycle,Step,Total Time (Seconds),Step Time (Seconds),Voltage (mV),Current (mA)",
            false,
            &|s| format!("1,1,1,2,{0},{0},{1},{2}", s.second, s.voltage_mv, -s.current_ma),
        ),
        (
            "Novonix",
            "3.csv",
            "[Data]\nDate and Time,Cycle Number,Step Type,Run Time (h),Current (A),Potential (V),Temperature (\u{b0}C)",
            true,
            &|s| format!("2023-11-14 22:13:20,0,2,{:.9},{},{},25", f64::from(s.second) / 3600.0, charged(s), v(s)),
        ),
        (
            "Torque",
            "4.csv",
            "GPS Time,Device Time, Longitude,HV Battery Current(A),HV Battery Voltage(V)",
            false,
            &|s| format!("-,{},-,{},{}", day(s), a(s), v(s)),
        ),
        ("VESC", "5.csv", "ms_today;input_voltage;temp_mos_max;current_motor;current_in", false, &|s| {
            format!("{};{};40;{};{}", 80_000_000 + 1000 * s.second, v(s), 3 * s.current_ma, a(s))
        }),
        (
            "Neware in Chinese",
            "6.csv",
            "\u{6570}\u{636e}\u{5e8f}\u{53f7},\u{603b}\u{65f6}\u{95f4},\u{7535}\u{6d41}(mA),\u{7535}\u{538b}(V)",
            false,
            &|s| format!("1,{},{},{}", clock(s.second), s.current_ma, v(s)),
        ),
        ("quoted separators", "7.csv", "\"Note, n\",Time (s),Current (A),Voltage (V)", false, &|s| {
            format!("\"a, b\",{},\"{}\",{}", s.second, a(s), v(s))
        }),
        ("Excel days", "8.csv", "Date,Current (A),Voltage (V)", false, &|s| {
            format!("{:.10},{},{}", 45_000.5 + f64::from(s.second) / 86_400.0, a(s), v(s))
        }),
        ("ms without a unit", "9.csv", "time,current,voltage", false, &|s| {
            format!("{},{},{}", 1000 * s.second, a(s), v(s))
        }),
        ("T next to a time", "10.csv", "T,Time,Current,Voltage", true, &|s| {
            format!("25,{},{},{}", s.second, a(s), v(s))
        }),
        ("texts for no value", "11.csv", "Time (s),Current (A),Voltage (V),Temp (C)", false, &|s| {
            format!(
                "{},{},{}{}",
                s.second,
                a(s),
                v(s),
                [",-", ",NaN", ",n/a", ",null", ",#N/A", ",", ""][s.second as usize % 7]
            )
        }),
        ("states in French", "12.csv", "Time (s),Current (A),Voltage (V),State", false, &|s| {
            magnitude(s, ["D\u{e9}charge", "Charge", "Repos"])
        }),
        ("states in German", "13.csv", "Time (s),Current (A),Voltage (V),State", false, &|s| {
            magnitude(s, ["Entladen", "Laden", "Not charging"])
        }),
        ("states as numbers", "14.csv", "Time (s),Current (A),Voltage (V),State", false, &|s| {
            magnitude(s, ["1", "0", "0"])
        }),
    ];
    all.map(|(name, file, head, has_temperature, row)| {
        export(name, file, has_temperature, table(head, rows, row, "\n"))
    })
    .into()
}
