//! Optimal assignment in a sparse graph.

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;

/// Gains are compared in these steps, as whole numbers: the same on every machine.
const STEPS: f64 = 1e9;

/// A pair that may be matched, and what that gains; above 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Edge {
    pub(crate) row: usize,
    pub(crate) column: usize,
    pub(crate) gain: f64,
}

/// The column of each row, so that the sum of the gains is largest. A row or column without a good
/// edge stays alone.
///
/// Each connected component is solved by itself (Kuhn and Munkres), so that the cost grows with the
/// number of components, not with its cube.
pub(crate) fn matching(rows: usize, columns: usize, edges: &[Edge]) -> Vec<Option<usize>> {
    let mut matched = vec![None; rows];
    let mut parent: Vec<usize> = (0..rows + columns).collect();
    for edge in edges {
        let (a, b) = (root(&mut parent, edge.row), root(&mut parent, rows + edge.column));
        parent[a.max(b)] = a.min(b);
    }
    let mut by_component: Vec<(usize, &Edge)> =
        edges.iter().map(|edge| (root(&mut parent, edge.row), edge)).collect();
    by_component.sort_by_key(|(component, _)| *component);
    for component in by_component.chunk_by(|a, b| a.0 == b.0) {
        match component {
            [(_, edge)] => matched[edge.row] = Some(edge.column),
            _ => solve(component, &mut matched),
        }
    }
    matched
}

fn solve(component: &[(usize, &Edge)], matched: &mut [Option<usize>]) {
    let distinct = |of: fn(&Edge) -> usize| {
        let mut all: Vec<usize> = component.iter().map(|(_, edge)| of(edge)).collect();
        all.sort_unstable();
        all.dedup();
        all
    };
    let (rows, columns) = (distinct(|edge| edge.row), distinct(|edge| edge.column));
    let is_wide = rows.len() <= columns.len();
    let size = if is_wide { [rows.len(), columns.len()] } else { [columns.len(), rows.len()] };
    // An edge that does not exist gains nothing.
    let mut gains = Matrix::new(size[0], size[1], 0_i64);
    for (_, edge) in component {
        let row = rows.partition_point(|row| *row < edge.row);
        let column = columns.partition_point(|column| *column < edge.column);
        let at = if is_wide { (row, column) } else { (column, row) };
        gains[at] = (edge.gain * STEPS) as i64;
    }
    for (first, second) in kuhn_munkres(&gains).1.into_iter().enumerate() {
        if gains[(first, second)] > 0 {
            let (row, column) = if is_wide { (first, second) } else { (second, first) };
            matched[rows[row]] = Some(columns[column]);
        }
    }
}

fn root(parent: &mut [usize], mut at: usize) -> usize {
    while parent[at] != at {
        parent[at] = parent[parent[at]];
        at = parent[at];
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::random::Draws;

    fn best(rows: usize, used: &mut Vec<usize>, edges: &[Edge]) -> f64 {
        let Some(row) = rows.checked_sub(1) else { return 0.0 };
        let mut most = best(row, used, edges);
        for edge in edges.iter().filter(|edge| edge.row == row) {
            if !used.contains(&edge.column) {
                used.push(edge.column);
                most = most.max(edge.gain + best(row, used, edges));
                used.pop();
            }
        }
        most
    }

    #[test]
    fn no_other_matching_gains_more() {
        for case in 0..60 {
            let draws = Draws { seed: case, stream: 0 };
            let (rows, columns) = (1 + case as usize % 5, 1 + case as usize / 5 % 6);
            let all = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
            let all = all.map(|(row, column)| {
                let gain = draws.uniform(1, (row * columns + column) as u64) - 0.4;
                Edge { row, column, gain }
            });
            let edges: Vec<Edge> = all.filter(|edge| edge.gain > 0.0).collect();
            let found = matching(rows, columns, &edges);
            let gain = |(row, column): (usize, &Option<usize>)| {
                let edge = edges.iter().find(|e| e.row == row && Some(e.column) == *column)?;
                Some(edge.gain)
            };
            let sum: f64 = found.iter().enumerate().filter_map(gain).sum();
            let mut columns: Vec<usize> = found.iter().flatten().copied().collect();
            columns.sort_unstable();
            assert!(columns.windows(2).all(|pair| pair[0] != pair[1]), "{found:?}");
            assert!((sum - best(rows, &mut Vec::new(), &edges)).abs() < 1e-6, "case {case}");
        }
    }
}
