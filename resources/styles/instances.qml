<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|AttributeTable">
  <renderer-v2 type="singleSymbol" symbollevels="0" referencescale="-1" enableorderby="0" forceraster="0">
    <symbols>
      <symbol type="fill" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleFill" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="0,0,255,255" name="color" />
            <Option type="QString" value="miter" name="joinstyle" />
            <Option type="QString" value="110,110,110,255" name="outline_color" />
            <Option type="QString" value="solid" name="outline_style" />
            <Option type="QString" value="0.3" name="outline_width" />
            <Option type="QString" value="MM" name="outline_width_unit" />
            <Option type="QString" value="no" name="style" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias name="Drive" field="drive" />
    <alias name="Local map" field="instance" />
    <alias name="Timestamp (ns)" field="timestamp_ns" />
    <alias name="X" field="x" />
    <alias name="Y" field="y" />
    <alias name="Heading" field="heading" />
    <alias name="Observations" field="n_observations" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="drive" hidden="0" width="-1" />
      <column type="field" name="instance" hidden="0" width="-1" />
      <column type="field" name="timestamp_ns" hidden="0" width="-1" />
      <column type="field" name="x" hidden="0" width="-1" />
      <column type="field" name="y" hidden="0" width="-1" />
      <column type="field" name="heading" hidden="0" width="-1" />
      <column type="field" name="n_observations" hidden="0" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>2</layerGeometryType>
</qgis>
