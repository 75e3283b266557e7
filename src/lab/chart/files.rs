//! Writes pictures as self-contained SVG files. Their colours follow the viewer's light or dark theme.

use std::path::Path;

use super::style::variables;
use super::{Picture, Size, escape};

/// Space around a picture in a file (pixels).
const MARGIN: f64 = 14.0;

/// A plot that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: the plot cannot be written: {what}")]
pub struct PlotError {
    path: String,
    what: String,
}

/// Writes each picture under its name into a folder.
///
/// # Errors
/// A file cannot be written.
pub fn write_each(folder: &Path, pictures: &[(String, Picture)]) -> Result<(), PlotError> {
    let write = |(name, picture): &(String, Picture)| {
        write_stack(&folder.join(format!("{name}.svg")), std::slice::from_ref(picture))
    };
    pictures.iter().try_for_each(write)
}

/// Writes pictures one below the other.
///
/// # Errors
/// The file cannot be written.
pub fn write_stack(path: &Path, pictures: &[Picture]) -> Result<(), PlotError> {
    let failed = |error: std::io::Error| PlotError { path: path.display().to_string(), what: error.to_string() };
    crate::write_file(path, document(pictures).as_bytes()).map_err(failed)
}

fn document(pictures: &[Picture]) -> String {
    let style = variables();
    let mut body = String::new();
    let mut y = MARGIN;
    for picture in pictures {
        let (elements, height) = picture.draw(Size::WIDE);
        body.push_str(&format!("<g transform=\"translate({MARGIN} {y:.1})\">{elements}</g>\n"));
        y += height + 12.0;
    }
    let (width, height) = (Size::WIDE.width + 2.0 * MARGIN, y);
    let name = pictures.first().map_or("", |picture| picture.title());
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height:.1}\" width=\"{width}\" height=\"{height:.1}\">\
         <title>{}</title><style>{style}</style><rect class=\"p\" width=\"100%\" height=\"100%\"/>\n{body}</svg>\n",
        escape(name)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Axis, Chart, Ink, Layer, Shape};

    fn picture() -> Picture {
        let layers = vec![Layer::new("95 %", Ink::Blue, Shape::Band(vec![(0.0, 0.5, 1.5), (1.0, 1.5, 2.5)]))];
        Picture::Chart(Chart { title: "cell & <1>".into(), y: Axis::number("V"), layers, ..Chart::default() })
    }

    #[test]
    fn file_is_self_contained_and_bad_path_is_reported() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("plot.svg");
        write_stack(&path, &[picture()]).expect("drawn");
        let text = std::fs::read_to_string(&path).expect("readable");
        assert!(text.starts_with("<svg") && text.trim_end().ends_with("</svg>"));
        assert!(text.contains("cell &amp; &lt;1&gt;") && text.contains("prefers-color-scheme:dark"));
        let error = write_stack(&folder.path().join("no/such.svg"), &[picture()]).expect_err("no folder");
        assert!(error.to_string().contains("such.svg: the plot cannot be written"), "{error}");
    }
}
