//! Builds the list of diagnostic answers that the core decodes, and the list of requests that `[poll]` sends.

use super::signals::ResolvedSignal;
use crate::can::poll::{PollConfig, PollRequest};
use crate::can::signal::LayoutFault;
use crate::can::uds::{Answer, AnswerSignal};
use crate::config::schema::RawTables;
use crate::quantity::Channel;

/// Returns the answers to decode: the answers that contain at least one signal of an input.
pub(crate) fn answers(found: &[ResolvedSignal<'_>]) -> Result<Vec<Answer>, LayoutFault> {
    let mut answers: Vec<Answer> = Vec::new();
    for (resolved, place) in found.iter().filter_map(|resolved| Some((resolved, resolved.answer?))) {
        let question = place.definition.question(resolved.bus);
        let signal = AnswerSignal { first_byte: place.first_byte, binding: resolved.binding()? };
        match answers.iter_mut().find(|answer| answer.question == question) {
            Some(answer) => answer.signals.push(signal),
            None => answers.push(Answer { question, signals: vec![signal] }),
        }
    }
    Ok(answers)
}

/// The requests to send; `None` = polling is off. Reports missing requirements.
pub(crate) fn poll(raw: &RawTables, found: &[ResolvedSignal<'_>]) -> Option<PollConfig> {
    let keys = raw.poll.as_ref().filter(|keys| keys.enabled)?;
    let mut requests: Vec<PollRequest> = Vec::new();
    for (resolved, place) in found.iter().filter_map(|resolved| Some((resolved, resolved.answer?))) {
        let question = place.definition.question(resolved.bus);
        let every_s = place.definition.every_s;
        if every_s == [None; 3] {
            continue;
        }
        let has_current = resolved.channel == Channel::Current;
        let has_voltages = matches!(resolved.channel, Channel::CellVoltage(_) | Channel::PackVoltage);
        match requests.iter_mut().find(|request| request.question == question) {
            Some(request) => {
                request.has_current |= has_current;
                request.has_voltages |= has_voltages;
            }
            None => requests.push(PollRequest { question, every_s, has_current, has_voltages }),
        }
    }
    if requests.is_empty() && !raw.broken {
        let what = "must be false, because nothing would be requested: no [[input.diagnostic]] whose signals are used has \
                    drive_every_s, charge_every_s or parked_every_s";
        keys.place.fault("enabled", what);
    }
    let current = found.iter().find(|resolved| resolved.channel == Channel::Current).and_then(|it| it.answer);
    if let Some(place) = current.filter(|place| place.definition.every_s[2].is_none()) {
        let table = &place.definition.table;
        let what = format!(
            "must be false, or {table} must have parked_every_s: without the current it is unknown whether the car drives"
        );
        keys.place.fault("enabled", &what);
    }
    let watches_supply = raw.supply_voltage.is_some();
    Some(PollConfig { requests, max_requests_per_s: keys.max_requests_per_s, watches_supply })
}
