//! Resources that a process uses, from `/proc` of Linux.

use std::fs;

/// Clock ticks per second in `/proc/PID/stat`; Linux uses 100 here on every system.
const TICKS: f64 = 100.0;

/// Resources that a process uses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Usage {
    /// Processor time of all its threads, user and system, seconds.
    pub cpu_s: f64,
    /// Resident memory, bytes.
    pub resident_bytes: u64,
}

impl Usage {
    /// Usage of the process with that id, or of this one. `None` if the system does not report it.
    pub fn of(process: Option<u32>) -> Option<Self> {
        let folder = process.map_or_else(|| "self".to_owned(), |number| number.to_string());
        let read = |file: &str| fs::read_to_string(format!("/proc/{folder}/{file}")).ok();
        Some(Self {
            cpu_s: cpu_s(&read("stat")?)?,
            resident_bytes: resident_bytes(&read("status")?)?,
        })
    }
}

/// Fields 14 and 15; the second field, the name in parentheses, may hold any character.
fn cpu_s(stat: &str) -> Option<f64> {
    let mut after_name = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || after_name.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / TICKS)
}

fn resident_bytes(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fields_are_found() {
        let stat = "12 (a ) b) S 1 1 1 0 -1 4194560 100 0 0 0 250 50 0 0 20 0 1 0 100 1 1";
        assert_eq!(cpu_s(stat), Some(3.0));
        assert_eq!(cpu_s("12 (a"), None);
        assert_eq!(resident_bytes("Name:\ta\nVmRSS:\t    2048 kB\n"), Some(2 << 20));
        assert_eq!(resident_bytes("Name:\ta\n"), None);
    }

    #[test]
    fn this_process_is_known_on_linux() {
        if cfg!(target_os = "linux") {
            assert!(Usage::of(None).is_some_and(|usage| usage.resident_bytes > 100_000));
        }
        assert_eq!(Usage::of(Some(u32::MAX)), None);
    }
}
