//! A method with another name.

use crate::core::manifold::Decoder;
use crate::research::methods::{Delay, Method, Solved, Take};

/// Delegates to a method; tables show the other name.
pub struct Named {
    name: String,
    method: Box<dyn Method>,
}

impl Named {
    /// A method with another name.
    pub fn boxed(name: impl Into<String>, method: Box<dyn Method>) -> Box<dyn Method> {
        Box::new(Self { name: name.into(), method })
    }
}

impl Method for Named {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn delay(&self, fps: f64) -> Delay {
        self.method.delay(fps)
    }

    fn solve(&mut self, take: &Take, decoder: &Decoder) -> Option<Solved> {
        self.method.solve(take, decoder)
    }
}
