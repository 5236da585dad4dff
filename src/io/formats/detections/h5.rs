//! DeepLabCut's h5: a table of pandas in an HDF5 file.

use csv::StringRecord;
use hdf5_reader::{Dataset, Datatype, Hdf5File};

use super::super::pickle;

/// Most bytes of a table.
const MOST_BYTES: usize = 4 << 30;

/// The lines of the same table as CSV.
///
/// # Errors
/// It is no HDF5 file, or holds no such table.
pub(super) fn lines(bytes: &[u8]) -> Result<Vec<StringRecord>, String> {
    let fault = |error: hdf5_reader::error::Error| format!("not HDF5 that can be read ({error})");
    let file = Hdf5File::from_vec(bytes.to_vec()).map_err(fault)?;
    let groups = file.root_group().and_then(|root| root.groups()).map_err(fault)?;
    let table = groups.iter().find_map(|group| group.dataset("table").ok()).ok_or(
        "no table of DeepLabCut; save CSV with deeplabcut.analyze_videos_converth5_to_csv",
    )?;
    if table.raw_byte_len().map_err(fault)? > MOST_BYTES {
        return Err("a table of more than 4 GiB".into());
    }
    let (columns, numbers) = (columns(&table)?, table.read_native_bytes().map_err(fault)?);
    let Datatype::Compound { size: row, .. } = table.dtype() else {
        return Err("a table without columns".into());
    };
    let levels: &[&str] = match columns.first().map(|column| column.levels.len()) {
        Some(3) => &["scorer", "bodyparts", "coords"],
        Some(4) => &["scorer", "individuals", "bodyparts", "coords"],
        _ => return Err("columns that are not those of DeepLabCut".into()),
    };
    let of_level = |(level, name): (usize, &&str)| {
        let cells =
            columns.iter().map(|column| column.levels.get(level).map_or("", String::as_str));
        std::iter::once(*name).chain(cells).collect::<StringRecord>()
    };
    let mut lines: Vec<StringRecord> = levels.iter().enumerate().map(of_level).collect();
    for (number, row) in numbers.chunks_exact(*row as usize).enumerate() {
        let cell = |column: &Column| column.number(row).map(|number| number.to_string());
        let cells = columns.iter().map(cell).collect::<Option<Vec<_>>>().ok_or("a row is cut")?;
        let index = index(&table, row).unwrap_or(number as i64).to_string();
        lines.push(std::iter::once(index).chain(cells).collect());
    }
    Ok(lines)
}

/// A column of numbers.
struct Column {
    /// Such as network, point and `x`.
    levels: Vec<String>,
    /// Place in a row, bytes.
    at: usize,
    /// 4 or 8 bytes.
    size: usize,
}

impl Column {
    fn number(&self, row: &[u8]) -> Option<f64> {
        let bytes = row.get(self.at..self.at + self.size)?;
        match self.size {
            4 => Some(f64::from(f32::from_ne_bytes(bytes.try_into().ok()?))),
            _ => Some(f64::from_ne_bytes(bytes.try_into().ok()?)),
        }
    }
}

/// The columns of all blocks; pandas keeps their names as pickles.
fn columns(table: &Dataset) -> Result<Vec<Column>, String> {
    let Datatype::Compound { fields, .. } = table.dtype() else { return Ok(Vec::new()) };
    let mut columns = Vec::new();
    for field in fields.iter().filter(|field| field.name.starts_with("values_block_")) {
        let (Datatype::Array { base, .. }, kind) =
            (&field.datatype, format!("{}_kind", field.name))
        else {
            continue;
        };
        let Datatype::FloatingPoint { size: size @ (4 | 8), .. } = **base else {
            return Err(format!("{} holds no numbers of 4 or 8 bytes", field.name));
        };
        let names = table.attribute(&kind).map_err(|_| format!("no attribute {kind}"))?;
        let names = pickle::value(&names.raw_data)?;
        for (i, name) in names.as_array().into_iter().flatten().enumerate() {
            let levels = name.as_array().into_iter().flatten();
            let levels =
                levels.map(|level| level.as_str().unwrap_or_default().to_owned()).collect();
            let size = usize::from(size);
            columns.push(Column { levels, at: field.byte_offset as usize + i * size, size });
        }
    }
    Ok(columns)
}

/// The frame number of a row, if the index has whole numbers.
fn index(table: &Dataset, row: &[u8]) -> Option<i64> {
    let Datatype::Compound { fields, .. } = table.dtype() else { return None };
    let field = fields.iter().find(|field| field.name == "index")?;
    let Datatype::FixedPoint { size: 8, .. } = field.datatype else { return None };
    let at = field.byte_offset as usize;
    Some(i64::from_ne_bytes(row.get(at..at + 8)?.try_into().ok()?))
}
