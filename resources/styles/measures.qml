<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Fields|Forms|AttributeTable">
  <aliases>
    <alias name="Class" field="class" />
    <alias name="Measure" field="measure" />
    <alias name="Unit" field="unit" />
    <alias name="Number" field="n" />
    <alias name="Value" field="value" />
    <alias name="Smallest" field="min" />
    <alias name="Largest" field="max" />
    <alias name="Standard deviation" field="std" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="measure" hidden="0" width="-1" />
      <column type="field" name="unit" hidden="0" width="-1" />
      <column type="field" name="n" hidden="0" width="-1" />
      <column type="field" name="value" hidden="0" width="-1" />
      <column type="field" name="min" hidden="0" width="-1" />
      <column type="field" name="max" hidden="0" width="-1" />
      <column type="field" name="std" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>4</layerGeometryType>
</qgis>
