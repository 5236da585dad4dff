//! Calibrations in XML: the attributes of one element of a camera.

use roxmltree::Node;

use super::Fault;

/// The attributes of one element of a camera.
pub(super) struct Fields<'a> {
    node: Node<'a, 'a>,
    camera: &'a str,
}

impl<'a> Fields<'a> {
    /// The first element with that tag below the camera's.
    pub fn of(camera: &Node<'a, 'a>, name: &'a str, tag: &str) -> Result<Self, Fault> {
        let node = camera.descendants().find(|child| child.has_tag_name(tag));
        let node = node.ok_or_else(|| Fault::Text(format!("camera {name}: no <{tag}>")))?;
        Ok(Self { node, camera: name })
    }

    /// The camera's own element.
    pub fn own(camera: &Node<'a, 'a>, name: &'a str) -> Self {
        Self { node: *camera, camera: name }
    }

    pub fn fault(&self, field: &str, what: &str) -> Fault {
        let tag = self.node.tag_name().name();
        Fault::Text(format!("camera {}: <{tag}> {field} {what}", self.camera))
    }

    pub fn text(&self, field: &str) -> Option<&'a str> {
        self.node.attribute(field)
    }

    pub fn number(&self, field: &str) -> Result<f64, Fault> {
        let text = self.text(field).ok_or_else(|| self.fault(field, "is missing"))?;
        text.trim().parse().map_err(|_| self.fault(field, "is not a number"))
    }

    /// Numbers between spaces.
    pub fn numbers<const N: usize>(&self, field: &str) -> Result<[f64; N], Fault> {
        let text = self.text(field).ok_or_else(|| self.fault(field, "is missing"))?;
        let all: Option<Vec<f64>> = text.split_whitespace().map(|word| word.parse().ok()).collect();
        let all = all.and_then(|all| all.try_into().ok());
        all.ok_or_else(|| self.fault(field, &format!("must be {N} numbers")))
    }
}
