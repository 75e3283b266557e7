//! Tests the cell fault detector with cells that are not compared.

use super::*;
use crate::cell_faults::difference::SOC;

#[test]
fn cell_no_longer_compared_is_reset() {
    let mut diagnosis = CellFaultDetector::new(6);
    diagnosis.middle = 4;
    diagnosis.lowest = Some(5);
    diagnosis.last_row = Some((Timestamp::ZERO, 0.5, 0.0));
    for cell in [1, 4] {
        diagnosis.cells[cell].settled[SOC] = 0.3;
        let cells = Some((CellIndex(cell as u16), CellIndex(cell as u16)));
        let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
        let (kind, since) = (CellFaultKind::VoltageChannel, Timestamp::ZERO);
        diagnosis.put(CellFault { kind, cells, since, reported: since, probability: 1.0, size });
    }
    let mut stored: CellFaultDetector = serde_json::from_str(&serde_json::to_string(&diagnosis).unwrap()).unwrap();
    stored.compare_only(&[0, 1, 2, 3]);
    assert_eq!((stored.middle, stored.lowest, stored.findings().len()), (0, None, 1));
    let faults = [0, 1, 4, 5].map(|cell| stored.has_channel_fault(CellIndex(cell)));
    assert_eq!(faults, [Some(false), Some(true), None, None]);
    assert_eq!(stored.sizes([CellFaultKind::Leak, CellFaultKind::Contact])[4], [None, None]);
    assert!(stored.difference(CellIndex(4)).is_none() && stored.difference(CellIndex(1)).is_some());
    assert_eq!(stored.relative(CellIndex(4)), Some([None; STATES]));
    let again: CellFaultDetector = serde_json::from_str(&serde_json::to_string(&stored).unwrap()).unwrap();
    assert_eq!(again, stored);
    stored.compare_only(&[0, 1, 2, 3, 4, 5]);
    assert_eq!((stored.cells[4].settled[SOC], stored.cells[1].settled[SOC]), (0.0, 0.3));
}
