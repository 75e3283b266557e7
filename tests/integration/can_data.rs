//! Decodes the pack voltage and current from the log of a real car, a Hyundai Kona. Its two buses use the same
//! identifier for different messages.

use std::io::Read;
use std::path::Path;

use crate::support::measured;
use packwatch::can::dbc::Database;
use packwatch::can::decode::{Binding, InputMap};
use packwatch::can::{CanId, Frame};
use packwatch::quantity::{BusIndex, Channel};

/// Frames of the log with their interface number. Every line has the form `(time) canN ID#DATA`.
fn frames(folder: &Path) -> Vec<(BusIndex, Frame)> {
    let file = std::fs::File::open(folder.join("kona2019_power_cycle_pcan_can0_ccan_can1.log.gz")).unwrap();
    let mut text = String::new();
    flate2::read::GzDecoder::new(file).read_to_string(&mut text).unwrap();
    let frame = |line: &str| {
        let mut words = line.split_whitespace().skip(1);
        let bus = words.next().unwrap().strip_prefix("can").unwrap().parse().unwrap();
        let (id, data) = words.next().unwrap().split_once('#').unwrap();
        let number = u32::from_str_radix(id, 16).unwrap();
        let id = if id.len() == 3 { CanId::standard(number) } else { CanId::extended(number) };
        let byte = |n: usize| u8::from_str_radix(&data[n..n + 2], 16).unwrap();
        let data: Vec<u8> = (0..data.len()).step_by(2).map(byte).collect();
        (BusIndex(bus), Frame::classic(id.unwrap(), &data).unwrap())
    };
    text.lines().map(frame).collect()
}

fn pack(folder: &Path, bus: u8) -> InputMap {
    let db = Database::parse_bytes(&std::fs::read(folder.join("kona_pcan.dbc")).unwrap()).unwrap();
    assert_eq!(db.messages.len(), 107);
    let bind = |name: &str, channel| {
        let (message, signal) = db.signal(name).unwrap();
        Binding::new(BusIndex(bus), message, signal, channel).unwrap()
    };
    InputMap::new(vec![
        bind("Batt_HV_Status.VBatt", Channel::PackVoltage),
        bind("Batt_HV_Status.IBatt", Channel::Current),
    ])
}

fn read(map: &InputMap, frames: &[(BusIndex, Frame)]) -> (Vec<f64>, Vec<f64>) {
    let (mut currents, mut voltages) = (Vec::new(), Vec::new());
    for (bus, frame) in frames {
        map.decode(*bus, frame, |reading| match reading.channel {
            Channel::Current => currents.push(reading.value.unwrap()),
            Channel::PackVoltage => {
                voltages.push(reading.value.unwrap());
                assert_eq!(currents.len(), voltages.len(), "the current of a frame must come before its voltage");
            }
            other => panic!("{other:?} was not bound"),
        });
    }
    (currents, voltages)
}

fn ends(values: &[f64]) -> (f64, f64) {
    (values.iter().copied().fold(f64::INFINITY, f64::min), values.iter().copied().fold(f64::NEG_INFINITY, f64::max))
}

fn near(found: f64, wanted: f64) -> bool {
    (found - wanted).abs() < 1e-9
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn kona_pack_signals_come_from_powertrain_bus_only() {
    let folder = measured::path("can_ev");
    let frames = frames(&folder);
    assert_eq!(frames.len(), 39_546);
    let of_id = |bus| frames.iter().filter(|(on, frame)| on.0 == bus && frame.id() == CanId::Standard(0x595)).count();
    assert_eq!((of_id(0), of_id(1)), (70, 108), "frames with the identifier per bus");
    let (currents, voltages) = read(&pack(&folder, 0), &frames);
    assert_eq!((currents.len(), voltages.len()), (70, 70), "readings must come from the bound interface only");
    let ((low_a, high_a), (low_v, high_v)) = (ends(&currents), ends(&voltages));
    let mean_a = currents.iter().sum::<f64>() / 70.0;
    eprintln!("70 frames: {low_v} to {high_v} V, {low_a} to {high_a} A, mean {mean_a:.4} A");
    assert!(near(low_v, 354.8) && near(high_v, 355.1), "{low_v} to {high_v} V");
    assert!(near(low_a, 0.0) && near(high_a, 3.4), "{low_a} to {high_a} A");
    assert!(near(mean_a, 112.3 / 70.0), "{mean_a} A");
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn same_identifier_on_other_bus_decodes_wrongly() {
    // A decoder that looks only at the identifier, not at the interface, would return these wrong values.
    let folder = measured::path("can_ev");
    let (currents, _) = read(&pack(&folder, 1), &frames(&folder));
    assert_eq!(currents.len(), 108);
    assert!(near(ends(&currents).1, 355.1));
}
