//! Recognises common file formats that packwatch cannot read, and names a tool that converts each of them.

/// Number of bytes before the magic of a TAR archive.
const TAR_MAGIC_AT: usize = 257;

/// Advice for text logs that few tools write.
const VIA_SAVVYCAN: &str = "open it in SavvyCAN and save it as GVRET CSV";

/// Takes the first bytes (at least 512) of a file that packwatch cannot read, and finds the format of the file. Returns
/// the name of the format and a sentence about its conversion: "SQLite database", "export a CSV with sqlite3 -csv".
/// `None` = unknown.
pub fn foreign(head: &[u8]) -> Option<(&'static str, &'static str)> {
    let begins = |magics: &[&[u8]]| magics.iter().any(|magic| head.starts_with(magic));
    let contains = |text: &[u8]| memchr::memmem::find(&head[..head.len().min(4096)], text).is_some();
    if begins(&[b"PK\x03\x04"]) {
        return Some(zipped(&contains));
    }
    let known: &[(&[&[u8]], _, _)] = &[
        (
            &[b"MDF     2.", b"MDF     3.", b"UnFinMF 3."],
            "MDF 3",
            "asammdf converts it: save as MDF 4.1 or export to ASC",
        ),
        (&[b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"], "MATLAB file", "export a CSV with MATLAB's writetable"),
        (&[b"\x89HDF\r\n\x1A\n"], "HDF5", "export a CSV with h5py or pandas"),
        (
            &[b"SQLite format 3\0"],
            "SQLite database",
            "export a CSV with sqlite3 -csv; can_logconvert converts those of python-can",
        ),
        (&[b"#ROSBAG V"], "ROS bag", "the rosbags tools export the CAN topic; write it as candump or CSV"),
        (&[b"\x89MCAP0\r\n"], "MCAP", "the mcap tools export topics; write the CAN topic as candump or CSV"),
        (&[b"DLT\x01"], "AUTOSAR DLT", "DLT Viewer exports it as text or CSV"),
        (&[b"%PDF-"], "PDF", "ask for the log itself; a document contains no measurements"),
        (&[b"\xD0\xCF\x11\xE0\xA1\xB1\x1A\xE1"], "Excel 97 workbook (.xls)", "save it as CSV"),
        (&[b"Rar!\x1A\x07"], "RAR archive", "extract it with unrar"),
        (&[b"7z\xBC\xAF\x27\x1C"], "7-Zip archive", "extract it with 7z x"),
        (&[b"BZh"], "bzip2", "decompress it with bunzip2"),
        (&[b"\xFD7zXZ\0"], "xz", "decompress it with unxz"),
        (&[b"\x04\x22\x4D\x18"], "LZ4", "decompress it with lz4 -d"),
        (&[b"TDSm"], "National Instruments TDMS", "export a CSV with npTDMS"),
        (&[b"ARROW1"], "Arrow or Feather file", "save it as Parquet or CSV"),
        (
            &[b"<?xml", b"<html", b"<!DOCTYPE"],
            "XML or HTML",
            "ask for the log itself; a web page was saved instead, perhaps",
        ),
        (&[b"{\"", b"[{", b"{\n", b"[\n"], "JSON", "write it as CSV, for example with jq -r @csv"),
    ];
    let first = head.split(|byte| matches!(byte, b'\n' | b'\r')).next().unwrap_or_default().to_ascii_lowercase();
    let first_has = |text: &[u8]| memchr::memmem::find(&first, text).is_some();
    if first.starts_with(b"line,abs time") || contains(b"Line,Abs Time(Sec)") {
        return Some(("Vehicle Spy CSV", VIA_SAVVYCAN));
    } else if contains(b"PP2CAN log file") {
        return Some(("PP2CAN log", VIA_SAVVYCAN));
    } else if contains(b"Microchip Technology Inc.") {
        return Some(("Microchip CAN BUS Analyzer log", VIA_SAVVYCAN));
    } else if first.starts_with(b"id,data bytes") {
        return Some(("list of frames without times", "record the frames with their times, for example as GVRET CSV"));
    } else if first_has(b"ixxat") {
        return Some(("IXXAT trace", VIA_SAVVYCAN));
    }
    if let Some((_, name, converter)) = known.iter().find(|(magics, ..)| begins(magics)) {
        return Some((name, converter));
    }
    if head.get(TAR_MAGIC_AT..).is_some_and(|rest| rest.starts_with(b"ustar")) {
        return Some(("TAR archive", "extract it with tar -xf"));
    }
    None
}

/// A ZIP container, which many formats use. The names of its first files decide.
fn zipped(contains: &dyn Fn(&[u8]) -> bool) -> (&'static str, &'static str) {
    if contains(b"xl/") || contains(b"[Content_Types].xml") {
        ("Excel workbook (.xlsx)", "save the sheet as CSV")
    } else if contains(b"mimetypeapplication/vnd.oasis.opendocument.spreadsheet") {
        ("OpenDocument spreadsheet (.ods)", "save the sheet as CSV")
    } else if contains(b".npy") {
        ("NumPy archive (.npz)", "write it as CSV with numpy.savetxt")
    } else {
        ("ZIP archive", "extract it with unzip")
    }
}
