//! Modules import only from below: the table in `src/lib.rs` against the paths in the sources.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

/// Where a module stands: its rank, and its place in the table.
type Place = (u32, usize);

/// Modules of this rank, the edges, never import each other.
const EDGES: u32 = 5;

/// Reads rows like ``| 0 | [`time`], [`so3`] | ... |``.
fn table(lib: &str) -> BTreeMap<String, Place> {
    let rows = lib.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("//! |")?.split('|');
        let rank: u32 = cells.next()?.trim().parse().ok()?;
        Some((rank, cells.next()?.to_owned()))
    });
    let modules = rows.flat_map(|(rank, names)| {
        let names: Vec<_> = names.split('`').skip(1).step_by(2).map(str::to_owned).collect();
        names.into_iter().map(move |name| (name, rank))
    });
    modules.enumerate().map(|(order, (name, rank))| (name, (rank, order))).collect()
}

fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<_> = fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .flat_map(|path| match path.is_dir() {
            true => sources(&path),
            false => vec![path],
        })
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .collect();
    found.sort();
    found
}

/// The code without comments and without the tests at its end.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
    text.lines().filter(|line| !line.trim_start().starts_with("//")).collect::<Vec<_>>().join("\n")
}

/// The first name of each path after `prefix`; for `prefix{a::b, c}` those of its branches.
fn heads(code: &str, prefix: &str) -> Vec<String> {
    let name = |text: &str| -> String {
        text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
    };
    code.match_indices(prefix)
        .filter(|(at, _)| {
            !code[..*at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':')
        })
        .flat_map(|(at, _)| match code[at + prefix.len()..].strip_prefix('{') {
            Some(group) => branches(group).iter().map(|branch| name(branch)).collect(),
            None => vec![name(&code[at + prefix.len()..])],
        })
        .collect()
}

/// Splits `a::{b, c}, d}...` at the commas outside inner braces, up to the closing one.
fn branches(group: &str) -> Vec<String> {
    let (mut depth, mut all) = (0, vec![String::new()]);
    for c in group.chars() {
        match c {
            '}' if depth == 0 => break,
            ',' if depth == 0 => all.push(String::new()),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                all.last_mut().unwrap().push(c);
            }
        }
    }
    all
}

fn is_allowed(from: Place, to: Place) -> bool {
    to.0 < from.0 || (to.0 == from.0 && to.1 <= from.1 && from.0 != EDGES)
}

#[test]
fn modules_import_only_from_lower_layers() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let table = table(&fs::read_to_string(root.join("lib.rs")).unwrap());
    assert!(table.len() > 10, "the table of layers in src/lib.rs cannot be read: {table:?}");

    let mut wrong = Vec::new();
    for path in sources(&root) {
        let inside = path.strip_prefix(&root).unwrap();
        let module = inside.components().next().unwrap().as_os_str().to_str().unwrap();
        let module = module.trim_end_matches(".rs");
        if ["lib", "main"].contains(&module) || inside.ends_with("tests.rs") {
            continue;
        }
        let Some(&from) = table.get(module) else {
            wrong.push(format!("{}: `{module}` is not in the table", inside.display()));
            continue;
        };
        let code = code(&fs::read_to_string(&path).unwrap());
        let mut used = heads(&code, "crate::");
        if inside.components().count() == 1
            || inside.ends_with("mod.rs") && inside.components().count() == 2
        {
            used.extend(heads(&code, "super::"));
        }
        for name in used.iter().filter(|name| *name != module) {
            match table.get(name) {
                Some(&to) if is_allowed(from, to) => {}
                Some(_) => wrong.push(format!("{} imports `{name}`", inside.display())),
                None => wrong.push(format!("{}: `{name}` is not in the table", inside.display())),
            }
        }
    }
    assert!(wrong.is_empty(), "imports against the layers:\n{}", wrong.join("\n"));
}

/// Functions whose last bits depend on the system's library.
const OF_THE_SYSTEM: [&str; 22] = [
    "sin", "cos", "tan", "sin_cos", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp",
    "exp2", "exp_m1", "ln", "ln_1p", "log", "log2", "log10", "powf", "cbrt", "hypot",
];

#[test]
fn what_solves_asks_the_system_for_no_function_whose_bits_differ() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let table = table(&fs::read_to_string(root.join("lib.rs")).unwrap());
    let solves = |path: &PathBuf| {
        let inside = path.strip_prefix(&root).unwrap();
        let module = inside.components().next().unwrap().as_os_str().to_str().unwrap();
        // Recordings are made by the node.
        let rank = table.get(module.trim_end_matches(".rs")).map_or(EDGES, |place| place.0);
        rank < EDGES || module == "node"
    };
    for path in sources(&root).iter().filter(|path| solves(path)) {
        let code = code(&fs::read_to_string(path).unwrap());
        for name in OF_THE_SYSTEM {
            let asked =
                code.contains(&format!(".{name}(")) || code.contains(&format!("f64::{name}"));
            assert!(!asked, "{}: use libm instead of `{name}`", path.display());
        }
    }
}

#[test]
fn the_check_sees_what_it_must() {
    let table = table("//! | 0 | [`time`], [`so3`] | x |\n//! | 5 | [`bus`], [`record`] | y |");
    let place = |name: &str| table[name];
    assert!(is_allowed(place("so3"), place("time")) && !is_allowed(place("time"), place("so3")));
    assert!(is_allowed(place("bus"), place("time")) && !is_allowed(place("time"), place("bus")));
    assert!(!is_allowed(place("record"), place("bus")));
    let code = code(
        "use crate::{a::{x, y}, b};\n// crate::no\nlet z = crate::c::d();\n#[cfg(test)]\nmod tests { crate::t",
    );
    assert_eq!(heads(&code, "crate::"), ["a", "b", "c"]);
}
