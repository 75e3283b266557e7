use packwatch_host::config;
use packwatch_host::quantity::{CellIndex, Channel, SensorIndex, Timestamp};
use packwatch_host::replay::MonitorDriver;
use std::io::Write;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let config = config::load(std::path::Path::new(&a[1])).unwrap();
    let every: f64 = a[3].parse().unwrap();
    let file = flate2::read::MultiGzDecoder::new(std::fs::File::open(&a[2]).unwrap());
    let mut r = csv::Reader::from_reader(file);
    let h = r.headers().unwrap().clone();
    let col = |n: &str| h.iter().position(|x| x == n);
    let (t, i, v, c) =
        (col("time_s").unwrap(), col("current_a").unwrap(), col("voltage_v").unwrap(), col("temperature_c"));
    let start = col("cycle").or(col("segment"));
    let mut d = MonitorDriver::new(config.monitor, 5.0e9);
    d.out.want_estimates = false;
    let (mut base, mut last, mut shown, mut seg) = (1000.0, 0.0, -1e9, String::new());
    let mut out = std::io::BufWriter::new(std::io::stdout().lock());
    for row in r.records() {
        let row = row.unwrap();
        let n = |k: usize| row[k].parse::<f64>().unwrap_or(f64::NAN);
        if let Some(s) = start {
            if row[s] != seg {
                seg = row[s].to_owned();
                base = last + 1000.0 + 1.0;
            }
        }
        let time = base + n(t);
        if !(time > last) {
            continue;
        }
        last = time;
        let temp = c.map_or(25.0, n);
        d.handle_row(
            Timestamp::from_secs(time),
            &[
                (Channel::Current, Some(n(i))),
                (Channel::CellVoltage(CellIndex(0)), Some(n(v))),
                (Channel::Temperature(SensorIndex(0)), Some(temp)),
            ],
        );
        d.out.clear();
        if time >= shown + every {
            shown = time;
            let p = d.monitor.pack_view();
            writeln!(
                out,
                "{{\"seg\":\"{seg}\",\"t\":{time},\"i\":{},\"v\":{},\"p\":{}}}",
                n(i),
                n(v),
                serde_json::to_string(&p).unwrap()
            )
            .unwrap();
        } else {
            writeln!(out, "{{\"seg\":\"{seg}\",\"t\":{time},\"i\":{},\"v\":{}}}", n(i), n(v)).unwrap();
        }
    }
}
